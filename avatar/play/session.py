"""What plays: the source of the motion, the sliders, and the thread that draws the latest picture while somebody watches.

A picture is drawn when something has changed and a page waits for one, never ahead: a slow avatar shows fewer pictures, not old
ones, and a closed page costs nothing.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from avatar.play.config import Change
from avatar.play.drawing import Drawer, jpeg
from avatar.play.driver import Driven, Driver
from avatar.play.rows import of_motion
from avatar.play.sliders import Panel
from avatar.uses.motion import Motion

WATCHED_S = 2.0
"""A page that has not asked for so long is not watching."""
FILMED = ("video", "camera")
PLAYED = ("clip", "file")


class Shown(NamedTuple):
    """A picture and what the page says of it."""

    number: int
    jpeg: bytes
    facts: dict[str, Any]


@dataclass
class Player:
    """A motion played in a loop by the clock."""

    motion: Motion
    place: float = 0.0
    """Frames since the start, as of `since_s`."""
    since_s: float | None = None
    """When it was set going; None while it rests."""

    def now(self, time_s: float) -> int:
        """The frame to show."""
        return int(self._at(time_s)) % len(self.motion)

    def _at(self, time_s: float) -> float:
        return self.place if self.since_s is None else self.place + (time_s - self.since_s) * self.motion.fps

    def go(self, playing: bool, time_s: float, place: int | None = None) -> None:
        """Play or rest, from the present frame or from `place`."""
        self.place = float(self._at(time_s) if place is None else place) % len(self.motion)
        self.since_s = time_s if playing else None


class Session:
    """Everything the page can ask for; safe to call from any thread."""

    def __init__(
        self,
        panel: Panel,
        motions: dict[str, Motion],
        new_drawer: Callable[[int], Drawer],
        size: int,
        new_driver: Callable[[Callable[[], None]], Driver] | None,
        filmed: tuple[str, ...] = (),
        quality: int = 90,
    ) -> None:
        """
        Args:
            motions: `clip`, and `file` where there is one.
            new_drawer: draws with `size` pixels on the longer side.
            new_driver: opens the driver, given what to call when it has something new; None where there is no detector.
            filmed: which of `video` and `camera` there are.
        """
        self.panel, self._new_drawer, self._new_driver, self._quality = panel, new_drawer, new_driver, quality
        self._players = {name: Player(motion) for name, motion in motions.items()}
        self._filmed = filmed if new_driver else ()
        self._changed = threading.Condition()
        self._source, self._playing, self._smooth, self._strength, self._size = "sliders", True, True, 1.0, size
        self._values = panel.at_rest()
        self._version, self._driver, self._stopped = 0, None, False
        self._shown: Shown | None = None
        self._drawn: tuple | None = None
        self._watched_s = -np.inf
        self._times: deque[float] = deque(maxlen=200)
        self._fault = ""
        self._thread = threading.Thread(target=self._draw, name="draw", daemon=True)
        self._thread.start()

    def sources(self) -> list[str]:
        """What may move the head."""
        with self._changed:
            return ["sliders", *self._players, *self._filmed]

    def state(self) -> dict[str, Any]:
        """What the page shows as chosen."""
        with self._changed:
            return {
                "version": self._version,
                "source": self._source,
                "sources": ["sliders", *self._players, *self._filmed],
                "playing": self._playing,
                "smooth": self._smooth,
                "strength": self._strength,
                "size": self._size,
                "sliders": dict(self._values),
                "frames": {name: len(player.motion) for name, player in self._players.items()},
            }

    def change(self, change: Change) -> int:
        """Do what a page asks; the version that pictures bear from then on. ValueError with one sentence where it cannot be."""
        with self._changed:
            values = self.panel.checked(change.sliders or {})
            source = change.source or self._source
            if source not in ("sliders", *self._players, *self._filmed):
                raise ValueError(f"there is no source {source} here")
            if change.place is not None and (source not in self._players or change.place >= len(self._players[source].motion)):
                raise ValueError(f"there is no frame {change.place} to go to")
            if change.reset:
                self._values, self._strength = self.panel.at_rest(), 1.0
            self._values |= values
            self._strength = self._strength if change.strength is None else change.strength
            self._size = change.size or self._size
            self._smooth = self._smooth if change.smooth is None else change.smooth
            self._playing = self._playing if change.playing is None else change.playing
            another, self._source = source != self._source, source
            now = time.monotonic()
            for name, player in self._players.items():
                player.go(self._playing and name == source, now, change.place if name == source else None)
            if source in FILMED:
                self._order(another or change.calibrate, change.neutral)
            self._version += 1
            self._changed.notify_all()
            return self._version

    def _order(self, forget: bool, neutral: bool) -> None:
        if self._driver is None:
            self._driver = self._new_driver(self._tell)
        self._driver.smoothing = self._smooth
        for what, wanted in (("forget", forget), ("neutral", neutral)):
            if wanted:
                self._driver.order(what)

    def offer(self, name: str, motion: Motion) -> None:
        """Take in a motion under the name of its source, and play it."""
        with self._changed:
            self._players[name] = Player(motion)
        self.change(Change(source=name, playing=True, place=0))

    def film(self, picture: np.ndarray | bytes, source: str, patience_s: float = 0.0) -> bool:
        """Give the driver a picture; False where another source plays or it rests."""
        with self._changed:
            driver = self._driver if self._source == source and self._playing and not self._stopped else None
        if driver is not None:
            driver.put(picture, patience_s)
        return driver is not None

    def filming(self, source: str) -> bool:
        """Whether pictures of a source are looked at now."""
        with self._changed:
            return self._source == source and self._playing and self._watched() and not self._stopped

    @property
    def driven(self) -> int:
        """How many pictures the driver has led to."""
        with self._changed:
            result = self._driver.result if self._driver else None
        return result.number if result else 0

    @property
    def stopped(self) -> bool:
        """Whether `stop` was called."""
        return self._stopped

    def preview(self) -> bytes | None:
        """The driver small with landmarks, as JPEG; None before the first picture."""
        with self._changed:
            result = self._driver.result if self._driver and self._source in FILMED else None
        return None if result is None else jpeg(result.preview, 80)

    def picture(self, after: int, patience_s: float) -> Shown | None:
        """The latest picture with a number above `after`; None where none comes in time."""
        end = time.monotonic() + patience_s
        with self._changed:
            while not self._stopped:
                asleep, self._watched_s = not self._watched(), time.monotonic()
                if asleep:  # only then: two pages that wake each other would never rest
                    self._changed.notify_all()
                if self._shown is not None and self._shown.number > after:
                    return self._shown
                left = end - time.monotonic()
                if left <= 0:
                    return None
                self._changed.wait(min(left, WATCHED_S / 2))
        return None

    def stop(self) -> None:
        """End the threads."""
        with self._changed:
            self._stopped = True
            self._changed.notify_all()
        self._thread.join(10)
        if self._driver is not None:
            self._driver.stop()

    def _tell(self) -> None:
        with self._changed:
            self._changed.notify_all()

    def _watched(self) -> bool:
        return time.monotonic() - self._watched_s < WATCHED_S

    def _wanted(self) -> tuple:
        """What the next picture would show: two equal ones are one picture."""
        player, driver = self._players.get(self._source), self._driver if self._source in FILMED else None
        place = player.now(time.monotonic()) if player else -1
        result = driver.result if driver else None
        return self._version, self._source, place, result.number if result else 0

    def _draw(self) -> None:
        """The thread."""
        drawers: dict[int, Drawer] = {}
        while True:
            with self._changed:
                while not self._stopped and not (self._watched() and self._wanted() != self._drawn):
                    moving = self._watched() and self._playing and self._source in PLAYED
                    self._changed.wait(0.004 if moving else None)
                if self._stopped:
                    return
                self._drawn = wanted = self._wanted()
                size, values, strength = self._size, dict(self._values), self._strength
                player, driver = self._players.get(self._source), self._driver if self._source in FILMED else None
            result = driver.result if driver else None
            base = self.panel.rest
            if player is not None:
                base = of_motion(player.motion, wanted[2])
            elif result is not None and result.row is not None:
                base = result.row
            picture = self._shown.jpeg if self._shown else b""
            facts = {"version": wanted[0], "source": wanted[1], "place": wanted[2]}
            try:
                if size not in drawers:
                    drawers = {size: self._new_drawer(size)}
                image = drawers[size].frame(self.panel.moved(base, values, strength))
                started = time.perf_counter()
                picture = jpeg(image, self._quality)
                times = drawers[size].milliseconds | {"jpeg": 1e3 * (time.perf_counter() - started)}
                facts |= self._figures(times, result) | {"size": list(image.shape[:2])}
            except Exception as error:  # noqa: BLE001 - whatever it is, the page must be told and the thread go on
                facts["fault"] = (str(error).splitlines() or [type(error).__name__])[0]
            with self._changed:
                self._shown = Shown(self._shown.number + 1 if self._shown else 1, picture, facts)
                self._changed.notify_all()

    def _figures(self, times: dict[str, float], result: Driven | None) -> dict[str, Any]:
        """Frames a second over the last two seconds, or between the last two pictures, and milliseconds of each stage."""
        now = time.monotonic()
        if self._times and now - self._times[-1] > 1 + 2e-3 * times["frame"]:
            self._times.clear()  # it rested
        self._times.append(now)
        recent = [moment for moment in self._times if now - moment <= 2]
        recent = recent if len(recent) > 1 else list(self._times)[-2:]
        fps = (len(recent) - 1) / (recent[-1] - recent[0]) if len(recent) > 1 else 0.0
        facts: dict[str, Any] = {"fps": round(fps, 2)}
        if result is not None:
            times = times | result.milliseconds
            facts |= {"found": result.found, "note": result.note, "driver": result.number}
        return facts | {"ms": {name: round(value, 2) for name, value in times.items()}}
