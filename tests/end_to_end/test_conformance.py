"""Our own drivers keep the contract that others are held to, and a driver that breaks it is told every law it broke."""

import pytest

from drivers.conformance import ContractBroken, check_scanner, check_stage
from drivers.scanners.known import open_free_running
from drivers.stages.face import StageReading
from simulators.pty_port import PtyPort
from tests.end_to_end.stages import BAUD, KINDS, new_device, open_stage, signed
from tests.end_to_end.test_scanners_on_pty import DEVICES, plugged


@pytest.mark.parametrize("kind", ["grbl", *[pytest.param(kind, marks=pytest.mark.long) for kind in KINDS[1:]]])
def test_every_stage_keeps_the_contract(kind):
    with PtyPort(new_device(kind), BAUD) as port:
        kept = check_stage(
            lambda: open_stage(kind, str(port.path)), (signed(kind, 2.0), signed(kind, 22.0)), speed_mm_per_s=20.0
        )
    assert len(kept) > 20


@pytest.mark.parametrize(
    "name", ["scip", *[pytest.param(name, marks=pytest.mark.long) for name in DEVICES if name != "scip"]]
)
def test_every_scanner_keeps_the_contract(name):
    with plugged(name) as port:
        kept = check_scanner(lambda: open_free_running(name, str(port.path)), lines=5, laser_always_on=name == "lms200")
    assert len(kept) > 15


class Careless:
    """A stage that goes anywhere at once, and forgets nothing it was asked."""

    position_known = False

    def enter(self):
        return self

    identity = ""

    def home(self):
        self.position_known = True

    def start_move(self, position_mm, speed_mm_per_s):
        self._at = position_mm

    def finish_move(self, timeout_s):
        return StageReading(self._at, 1.0, 0.0, True)

    def move_to(self, position_mm, speed_mm_per_s):
        self._at = position_mm
        return StageReading(position_mm + 5.0, 1.0, 0.0, True)

    def readings(self):
        return [StageReading(0.0, 2.0, 1.0, True), StageReading(0.0, 1.0, 2.0, True)]

    def stop(self):
        pass

    def exit(self):
        pass


def test_a_careless_stage_is_told_every_law_it_broke():
    with pytest.raises(ContractBroken) as caught:
        check_stage(Careless, (0.0, 10.0))
    broken = "\n".join(caught.value.laws)
    for law in (
        "enter returns an identity",
        "no motion while the position is unknown",
        "a target of nan mm is refused",
        "a speed of 0 mm/s is refused",
        "move_to returns where the stage rests",
        "a second motion is refused",
        "readings come in order",
        "a reading was asked for before it arrived",
        "a reading is handed out once",
        "whoever waits for a stopped motion is told",
    ):
        assert law in broken
