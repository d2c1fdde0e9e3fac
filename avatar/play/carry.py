"""A driver's pose as the subject would make it, one frame at a time. Arrays in, arrays out.

Turn and place are the driver's beyond his own at the start (or since `set_neutral`); codes and gaze go over as they are, for the
solver has found who the driver is, until `set_neutral` says what his resting face is: then they go over as
`retarget.carried`, from rest to rest. Measured on the last 150 frames of nerface.mp4 as a driver of an avatar of the first 354,
against the fit of the whole clip, in rms of the face, whose motion is 1.85 mm: copied codes are 0.79 mm off (median of six
calibrations on a second of film, 0.56 to 1.25; 1.06 with the mean head); from a neutral taken somewhere 1.3 mm (0.6 to 2.0),
from the calmest third of a second 0.8 mm (0.75 to 0.95). Who begins to film himself is not at rest yet; he says when he is.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from avatar.play.rows import Body, Row
from avatar.uses import retarget
from fitting.camera import exp_rotation, log_rotation
from fitting.head_model import HeadModel
from fitting.rig import Pose

NEUTRAL_FRAMES = 10
"""A neutral face and pose are the median of this many last frames."""


class Carrier:
    """Carries the poses of one driver over to one subject."""

    def __init__(self, head: HeadModel, body: Body, rest_row: Row, rest: retarget.Rest) -> None:
        """
        Args:
            body, rest_row, rest: the subject's (see `rows.rest_row`).
        """
        self._head, self._body, self._rest_row, self._rest = head, body, rest_row, rest
        self._ends = tuple(end.numpy().astype(np.float64) for end in (head.expression_low, head.expression_high))
        self._recent: deque[Row] = deque(maxlen=NEUTRAL_FRAMES)
        self.begin(np.zeros(len(head.shape_basis)))

    def begin(self, shape: np.ndarray) -> None:
        """A driver of this identity [S]: his next frames are his start."""
        self._driver = Body.of(self._head, shape)
        self._size_m = retarget.face_size_m(self._head, shape)
        self._recent.clear()
        self._start: retarget.Rest | None = None
        self._own_neutral = False

    @property
    def at_start(self) -> bool:
        """The start is still being looked for."""
        return self._start is None

    def set_neutral(self) -> bool:
        """The last frames' face and pose are neutral from now on; False where there are none yet."""
        if not self._recent:
            return False
        self._start, self._own_neutral = self._median(), True
        return True

    def _median(self) -> retarget.Rest:
        rows = self._recent
        middle = {name: np.median([getattr(row, name) for row in rows], 0) for name in ("expression", "jaw", "eyes", "rotation")}
        centre = np.median([row.translation for row in rows], 0)
        return retarget.Rest((), middle["expression"], middle["jaw"], middle["eyes"], centre, middle["rotation"], self._size_m)

    def carried(self, pose: Pose) -> Row:
        """The subject's row for the driver's pose."""
        # The translation of this row is the middle of the driver's face.
        centre = pose.rotation @ self._driver.face_m + pose.translation
        row = Row(pose.expression, log_rotation(pose.rotation), np.zeros(3), pose.jaw, pose.vectors[1:], centre)
        self._recent.append(row)
        if self._start is None and len(self._recent) == NEUTRAL_FRAMES:
            self._start = self._median()
        start = self._start or self._median()
        if self._own_neutral:
            rest = self._rest_row
            row = row._replace(
                expression=retarget.carried(row.expression, start.expression, rest.expression, *self._ends),
                jaw=rest.jaw + row.jaw - start.jaw,
                eyes=rest.eyes + row.eyes - start.eyes,
            )
        turn = pose.rotation @ exp_rotation(start.rotation).T @ exp_rotation(self._rest_row.rotation)
        row = row._replace(rotation=log_rotation(turn), translation=np.zeros(3))
        return self._body.placed(row, retarget.places(centre[None], start, self._rest)[0])
