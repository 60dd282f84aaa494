"""What a plan is to serve: everything, or named regions and reasons; knows no surface and no rig."""

from dataclasses import dataclass

from scanner_service.rescan.judgement import Reason
from scanner_service.rescan.region import RescanRegion


@dataclass(frozen=True, slots=True)
class Serving:
    """Regions by their numbers (ids where they are followed) and by reason; nothing named: everything, unseen surface
    included.
    """

    regions: frozenset[int] = frozenset()
    reasons: frozenset[Reason] = frozenset()

    @property
    def is_everything(self) -> bool:
        """True when nothing is named."""
        return not (self.regions or self.reasons)

    def wants(self, region: RescanRegion) -> bool:
        """Whether a region is to be served; an isolated point never is, since no pass is its remedy."""
        if region.reason is Reason.ISOLATED:
            return False
        if self.is_everything:
            return True
        return region.number in self.regions or region.reason in self.reasons


EVERYTHING = Serving()
