"""The world: a small file in memory that says how the arm moves, for all who stand in the scene.

The arm writes a record whenever a command takes effect; the camera, and whoever judges the loop,
work out from it where the arm is at any instant since. This is physics, not a message: it reaches
processes of one machine at once, whatever becomes of the network between their nodes.

The file is a ring of records, each with a check sum. A reader copies the ring and takes no record
whose sum is wrong, so that a torn read, or a writer killed within a write, costs the newest record
at most, whatever order the processor makes the stores visible in. The scene stands in front.
"""

from __future__ import annotations

import contextlib
import math
import mmap
import os
import struct
import tempfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from dwell.errors import LiveError
from dwell.model.instants import NEVER_NS

from .scene import Array, Axes, Limits, Scene

_MAGIC = b"dwell-world-1\n"
_FRONT_BYTES = 2048
_RECORDS = 64
_NUMBER = struct.Struct("<q")
_BODY = struct.Struct("<4q12d2dq2d")
_SUM = struct.Struct("<I4x")
_RECORD_BYTES = _BODY.size + _SUM.size
_SIZE_BYTES = _FRONT_BYTES + _RECORDS * _RECORD_BYTES


@dataclass(frozen=True, slots=True)
class Motion:
    """How the arm moves from an instant on: with limited acceleration to a commanded velocity.

    Parameters
    ----------
    at_ns : int
    position, velocity, command : tuple of float
        Of x, y, z and yaw: at that instant, and the velocity they go for.
    expires_ns : int
        From when on the drives stop by themselves, for lack of a command.
    """

    at_ns: int
    position: Axes
    velocity: Axes
    command: Axes = (0.0, 0.0, 0.0, 0.0)
    expires_ns: int = NEVER_NS

    def state(self, at_ns: int, limits: Limits) -> tuple[Array, Array]:
        """Return position and velocity at an instant, in closed form, shapes (4,).

        Before `at_ns`, they are those of `at_ns`. An axis beyond its end stop stands at it.
        """
        until_s = (min(at_ns, self.expires_ns) - self.at_ns) * 1e-9
        position, velocity = np.array(self.position), np.array(self.velocity)
        reach = np.array(limits.acceleration)
        position, velocity = _ramp(position, velocity, np.array(self.command), reach, until_s)
        if at_ns > self.expires_ns:
            stopping_s = (at_ns - max(self.expires_ns, self.at_ns)) * 1e-9
            position, velocity = _ramp(position, velocity, np.zeros(4), reach, stopping_s)
        inside = np.clip(position, limits.low, limits.high)
        return inside, np.where(inside == position, velocity, 0.0)


def _ramp(
    position: Array, velocity: Array, command: Array, acceleration: Array, for_s: float
) -> tuple[Array, Array]:
    """Return position and velocity after so many seconds of going for a commanded velocity."""
    for_s = max(0.0, for_s)
    missing = command - velocity
    ramp_s = np.minimum(np.abs(missing) / acceleration, for_s)
    gained = np.sign(missing) * acceleration * ramp_s
    gained = np.where(ramp_s < for_s, missing, gained)
    moved = velocity * ramp_s + 0.5 * gained * ramp_s + (velocity + gained) * (for_s - ramp_s)
    return position + moved, velocity + gained


@dataclass(frozen=True, slots=True)
class Worth:
    """What the loop is worth, as of an actuation: the error then, and those of all until then.

    Parameters
    ----------
    actuations : int
    taken_ns : int
        When the picture behind the command was taken; 0 for a watchdog's.
    error_mm, error_px : float
        See `Scene.errors`.
    squares_mm2, squares_px2 : float
        Sums of their squares over all actuations.
    """

    actuations: int = 0
    taken_ns: int = 0
    error_mm: float = 0.0
    error_px: float = 0.0
    squares_mm2: float = 0.0
    squares_px2: float = 0.0

    def then(self, taken_ns: int, error_mm: float, error_px: float) -> Worth:
        """Return the worth as of the next actuation."""
        return Worth(
            self.actuations + 1,
            taken_ns,
            error_mm,
            error_px,
            self.squares_mm2 + error_mm**2,
            self.squares_px2 + error_px**2,
        )

    def rms_since(self, earlier: Worth) -> tuple[float, float]:
        """Return the root mean squares in mm and px of the actuations since; NaN for none."""
        count = self.actuations - earlier.actuations
        if count <= 0:
            return math.nan, math.nan
        squares_mm2 = max(0.0, self.squares_mm2 - earlier.squares_mm2)
        squares_px2 = max(0.0, self.squares_px2 - earlier.squares_px2)
        return math.sqrt(squares_mm2 / count), math.sqrt(squares_px2 / count)


class World:
    """The file, open to read and, for the one process that is the arm, to write.

    Parameters
    ----------
    path : Path
        Made by `create`.

    Attributes
    ----------
    scene : Scene

    Raises
    ------
    LiveError
        If there is none, or it is something else.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            with path.open("r+b") as file:
                self._map = mmap.mmap(file.fileno(), _SIZE_BYTES)
        except (OSError, ValueError) as error:
            raise LiveError(f"{path}: no world of the demo: {error}") from None
        if self._map[: len(_MAGIC)] != _MAGIC:
            self._map.close()
            raise LiveError(f"{path}: not a world of this version of the demo; delete it")
        front = self._map[len(_MAGIC) : _FRONT_BYTES].rstrip(b"\0")
        try:
            self.scene = msgspec.json.decode(front, type=Scene)
        except msgspec.MsgspecError as error:
            raise LiveError(f"{path}: no scene: {error}; delete it") from None

    @classmethod
    def create(cls, path: Path, scene: Scene, at_ns: int) -> World:
        """Make the file, the arm at home; one that is there already is opened and left as it is."""
        front = _MAGIC + msgspec.json.encode(scene)
        home = _written(0, Motion(at_ns, scene.home, (0.0, 0.0, 0.0, 0.0)), Worth())
        with tempfile.NamedTemporaryFile(dir=path.parent) as file:
            file.write((front.ljust(_FRONT_BYTES, b"\0") + home).ljust(_SIZE_BYTES, b"\0"))
            file.flush()
            # A link appears whole or not at all, and never in place of another file.
            with contextlib.suppress(FileExistsError):
                os.link(file.name, path)
        return cls(path)

    @classmethod
    def open(cls, path: Path | None, at_ns: int) -> World:
        """Open the file, made with the usual scene if need be.

        Without a path, it is the one that the environment's DWELL_WORLD names, or else one of this
        user's for all demos of the machine.
        """
        usual = Path(tempfile.gettempdir()) / f"dwell-world-{os.getuid()}"
        path = path or Path(os.environ.get("DWELL_WORLD", usual))
        return cls(path) if path.exists() else cls.create(path, Scene(), at_ns)

    def close(self) -> None:
        """Let go of the file; it stays."""
        self._map.close()

    def records(self) -> Iterator[tuple[int, Motion, Worth]]:
        """Go through the records, newest first, each with its number; 1 to 64 of them.

        Raises
        ------
        LiveError
            If none is whole: somebody else writes this file.
        """
        data = self._map[_FRONT_BYTES:_SIZE_BYTES]
        starts = range(0, len(data), _RECORD_BYTES)
        found = False
        for _, start in sorted(
            ((_NUMBER.unpack_from(data, at), at) for at in starts), reverse=True
        ):
            record = _read(data, start)
            if record is not None:
                found = True
                yield record
        if not found:
            raise LiveError(f"{self.path}: no whole record; delete it")

    def newest(self) -> tuple[int, Motion, Worth]:
        """Return the newest record."""
        return next(self.records())

    def state(self, at_ns: int) -> tuple[Array, Array]:
        """Return the arm's position and velocity at an instant, shapes (4,).

        An instant before the newest command is seen as it was, as far as the ring reaches back.
        """
        for _, motion, _ in self.records():
            if motion.at_ns <= at_ns:
                break
        return motion.state(at_ns, self.scene.limits)

    def errors(self, at_ns: int) -> tuple[float, float]:
        """Return the tracking error at an instant, in mm and px."""
        return self.scene.errors(self.state(at_ns)[0], at_ns)

    def write(self, motion: Motion, worth: Worth) -> None:
        """Add a record."""
        number = self.newest()[0] + 1
        start = _FRONT_BYTES + number % _RECORDS * _RECORD_BYTES
        self._map[start : start + _RECORD_BYTES] = _written(number, motion, worth)


def _written(number: int, motion: Motion, worth: Worth) -> bytes:
    body = _BODY.pack(
        number,
        motion.at_ns,
        motion.expires_ns,
        worth.taken_ns,
        *motion.position,
        *motion.velocity,
        *motion.command,
        worth.error_mm,
        worth.error_px,
        worth.actuations,
        worth.squares_mm2,
        worth.squares_px2,
    )
    return body + _SUM.pack(zlib.crc32(body))


def _read(data: bytes, start: int) -> tuple[int, Motion, Worth] | None:
    body = data[start : start + _BODY.size]
    # A slot never written is all zeros: so is no record, whose sum then would have to be 0.
    if _SUM.unpack_from(data, start + _BODY.size)[0] != zlib.crc32(body):
        return None
    number, at_ns, expires_ns, taken_ns, *floats = _BODY.unpack(body)
    error_mm, error_px, actuations, squares_mm2, squares_px2 = floats[12:]
    position, velocity, command = tuple(floats[:4]), tuple(floats[4:8]), tuple(floats[8:12])
    motion = Motion(at_ns, position, velocity, command, expires_ns)
    return number, motion, Worth(actuations, taken_ns, error_mm, error_px, squares_mm2, squares_px2)
