"""Frames that move with respect to each other, as ROS's `tf` tells them."""

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from splatpilot.systems.pose_between import pose_between

_MAX_GAP = 0.12
"""[s] between two poses that one is interpolated from."""


class TransformTree:
    """Frames by name, each with its parent, at rest in it or moving."""

    def __init__(self) -> None:
        self._parents: dict[str, str] = {}
        self._fixed: dict[str, RigidTransform] = {}
        self._moving: dict[str, list[tuple[float, RigidTransform]]] = {}
        self._times: dict[str, NDArray[np.float64]] = {}  # of what is sorted

    def fix(self, parent: str, child: str, X_PC: RigidTransform) -> None:
        """Says where a frame always is."""
        self._parents[child], self._fixed[child] = parent, X_PC

    def move(self, parent: str, child: str, time: float, X_PC: RigidTransform) -> None:
        """Says where a frame was at a time [s]."""
        self._parents[child] = parent
        self._moving.setdefault(child, []).append((time, X_PC))
        self._times.pop(child, None)

    def fixed_pose(self, ancestor: str, frame: str) -> RigidTransform | None:
        """The pose of a frame in one above it, None unless all between them is at rest."""
        X = RigidTransform()
        for name in self._upwards(frame):
            if name == ancestor:
                return X
            if name not in self._fixed:
                return None
            X = self._fixed[name] @ X
        return None

    def pose(self, frame: str, time: float) -> RigidTransform | None:
        """The pose of a frame in its root at a time [s], None where the poses around it are too far
        apart or missing."""
        X = RigidTransform()
        for name in self._upwards(frame):
            if name not in self._parents:
                return X
            here = self._fixed.get(name) or self._interpolated(name, time)
            if here is None:
                return None
            X = here @ X
        return None

    def _upwards(self, frame: str) -> list[str]:
        """The frame, its parent, and so on; not round and round."""
        names = [frame]
        while (parent := self._parents.get(names[-1])) is not None and parent not in names:
            names.append(parent)
        return names

    def _interpolated(self, child: str, time: float) -> RigidTransform | None:
        poses = self._moving.get(child, [])
        if child not in self._times:
            poses.sort(key=lambda pose: pose[0])
            self._times[child] = np.array([t for t, _ in poses])
        times = self._times[child]
        after = int(np.searchsorted(times, time))
        if after < len(times) and times[after] == time:
            return poses[after][1]
        if not 0 < after < len(times) or times[after] - times[after - 1] > _MAX_GAP:
            return None
        (t0, a), (t1, b) = poses[after - 1], poses[after]
        return pose_between(a, b, (time - t0) / (t1 - t0))
