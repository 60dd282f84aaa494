"""How axes move: blocks one after another, each from rest to rest with a trapezoid of speed; knows no clock."""

import math
from collections import deque
from dataclasses import dataclass

Vector = tuple[float, ...]


@dataclass(frozen=True, slots=True)
class _Profile:
    """Distance over time: `accelerate_s` up to `top` speed, `cruise_s` at it, `brake_s` down to rest."""

    top: float
    acceleration: float
    accelerate_s: float
    cruise_s: float
    brake_s: float

    @property
    def duration_s(self) -> float:
        return self.accelerate_s + self.cruise_s + self.brake_s

    def distance(self, t: float) -> float:
        t = min(max(t, 0.0), self.duration_s)
        a, up = self.acceleration, min(t, self.accelerate_s)
        gone = 0.5 * a * up * up
        gone += self.top * min(max(t - self.accelerate_s, 0.0), self.cruise_s)
        down = max(t - self.accelerate_s - self.cruise_s, 0.0)
        return gone + self.top * down - 0.5 * a * down * down

    def speed(self, t: float) -> float:
        if not 0.0 <= t < self.duration_s:
            return 0.0
        if t < self.accelerate_s:
            return self.acceleration * t
        return self.top - self.acceleration * max(t - self.accelerate_s - self.cruise_s, 0.0)


def _profile(length: float, speed: float, acceleration: float) -> _Profile:
    top = min(speed, math.sqrt(length * acceleration))
    up_s = top / acceleration
    return _Profile(top, acceleration, up_s, max(0.0, (length - top * up_s) / top) if top else 0.0, up_s)


@dataclass(frozen=True, slots=True)
class _Block:
    target: Vector
    speed: float


class Axes:
    """Several axes that move together along straight lines.

    Parameters
    ----------
    count : how many axes.
    acceleration : of the path, units/s².
    """

    def __init__(self, count: int, acceleration: float) -> None:
        self._acceleration = acceleration
        self._start: Vector = (0.0,) * count
        self._end: Vector = self._start
        self._profile: _Profile | None = None
        self._since_s = 0.0
        self._queue: deque[_Block] = deque()
        self._held: list[_Block] = []

    def position(self, now_s: float) -> Vector:
        """Where the axes are."""
        self._advance(now_s)
        if self._profile is None:
            return self._start
        length = math.dist(self._start, self._end)
        share = self._profile.distance(now_s - self._since_s) / length if length else 1.0
        return tuple(a + (b - a) * min(share, 1.0) for a, b in zip(self._start, self._end, strict=True))

    def speed(self, now_s: float) -> float:
        """How fast they go."""
        self._advance(now_s)
        return 0.0 if self._profile is None else self._profile.speed(now_s - self._since_s)

    def is_moving(self, now_s: float) -> bool:
        """True until the last block has come to its end."""
        self._advance(now_s)
        return self._profile is not None

    def blocks(self, now_s: float) -> int:
        """Blocks under way or waiting."""
        self._advance(now_s)
        return len(self._queue) + (self._profile is not None)

    def planned(self) -> Vector:
        """Where they will be when everything is done."""
        return self._queue[-1].target if self._queue else self._end

    def go(self, target: Vector, speed: float, now_s: float) -> None:
        """Queue a motion."""
        self._advance(now_s)
        self._queue.append(_Block(target, speed))
        if self._profile is None:
            self._since_s = now_s
            self._next()

    def brake(self, now_s: float, *, keep: bool = False) -> None:
        """Slow down to rest; what waited is forgotten, or with `keep` goes on at `resume`."""
        self._advance(now_s)
        if self._profile is None:
            return
        here, speed = self.position(now_s), self.speed(now_s)
        length = math.dist(self._start, self._end)
        left = length - math.dist(self._start, here)
        needed = min(left, 0.5 * speed * speed / self._acceleration)
        share = needed / left if left > 1e-12 else 0.0
        rest = tuple(a + (b - a) * share for a, b in zip(here, self._end, strict=True))
        waiting = [_Block(self._end, max(self._profile.top, 1e-9)), *self._queue] if keep else []
        self._queue.clear()
        self._held = waiting
        self._start, self._end, self._since_s = here, rest, now_s
        if math.dist(here, rest) < 1e-12:
            self._rest()
        else:
            self._profile = _Profile(speed, self._acceleration, 0.0, 0.0, speed / self._acceleration)

    def resume(self, now_s: float) -> None:
        """Go on with what `brake` kept."""
        waiting, self._held = self._held, []
        for block in waiting:
            self.go(block.target, block.speed, now_s)

    def halt(self, now_s: float) -> None:
        """Stand still at once and forget everything."""
        here = self.position(now_s)
        self._queue.clear()
        self._held = []
        self.put(here)

    def put(self, position: Vector) -> None:
        """Be somewhere."""
        self._start = self._end = position
        self._profile = None

    def _rest(self) -> None:
        self._start = self._end
        self._profile = None

    def _advance(self, now_s: float) -> None:
        while self._profile is not None and now_s - self._since_s >= self._profile.duration_s:
            self._since_s += self._profile.duration_s
            self._rest()
            self._next()

    def _next(self) -> None:
        while self._queue and self._profile is None:
            block = self._queue.popleft()
            length = math.dist(self._start, block.target)
            if length < 1e-12:
                continue
            self._end = block.target
            self._profile = _profile(length, block.speed, self._acceleration)
