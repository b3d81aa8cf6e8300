"""Perception: the tag's pose in a picture, by OpenCV's detector of AprilTags and `solvePnP`.

Corners are refined to fractions of a pixel. From the four corners of a square, the pose is that of
Collins and Bartoli 2014, DOI 10.1007/s11263-014-0725-5 (IPPE), the better of its two solutions.
"""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import msgspec
import numpy as np

from dwell.errors import LiveError
from dwell.live.stage import Message

from .camera import Picture, read_mark
from .messages import Pose
from .scene import Array, Scene

# Numbers 0 to 29 are in use here: a detector compares whatever looks like a tag with all it knows.
_TAGS = 30
# The solver wants the square in a frame whose y points up and z at the camera; ours is turned by
# half a turn about x.
_HALF_TURN = np.diag([1.0, -1.0, -1.0])


class Perception:
    """Finds the tag.

    Parameters
    ----------
    scene : Scene
        Its camera and tag: known from calibration.
    threads : int
        Of OpenCV.
    """

    def __init__(self, scene: Scene | None = None, *, threads: int = 1) -> None:
        cv2.setNumThreads(threads)
        self.scene = scene or Scene()
        family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
        in_use = cv2.aruco.Dictionary(
            family.bytesList[:_TAGS], family.markerSize, family.maxCorrectionBits
        )
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        self._detector = cv2.aruco.ArucoDetector(in_use, parameters)
        half = self.scene.tag_m / 2
        self._square = half * np.array([[-1.0, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
        self._camera = self.scene.camera.matrix

    def process(self, inputs: Mapping[str, Message]) -> Message:
        """Find the tag in the picture of a cycle.

        Raises
        ------
        LiveError
            If there is no picture in the message.
        """
        (message,) = inputs.values()
        return Message(self.locate(message.payload))

    def locate(self, data: object) -> Pose:
        """Find the tag in a picture, raw or JPEG, that ends with a mark."""
        if not isinstance(data, np.ndarray) or data.dtype != np.uint8:
            raise LiveError(f"a picture has to be an array of 8-bit pixels, not {type(data)}")
        unseen = read_mark(data)
        camera = self.scene.camera
        picture = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE) if data.ndim == 1 else data
        if picture is None or picture.shape != (camera.height, camera.width):
            raise LiveError(f"no picture of {camera.width} x {camera.height} pixels")
        corners = self.corners(np.asarray(picture, np.uint8))
        if corners is None:
            return unseen
        found, turn, at = cv2.solvePnP(
            self._square, corners, self._camera, None, flags=cv2.SOLVEPNP_IPPE_SQUARE
        )
        if not found or not np.isfinite(turn).all() or at[2, 0] <= 0:
            return unseen
        turned, _ = cv2.Rodrigues(np.asarray(cv2.Rodrigues(turn)[0]) @ _HALF_TURN)
        return msgspec.structs.replace(
            unseen,
            found=True,
            corners=len(corners),
            position=tuple(float(value) for value in at.ravel()),
            turned=tuple(float(value) for value in turned.ravel()),
        )

    def corners(self, picture: Picture) -> Array | None:
        """Return the tag's corners in pixels, clockwise from its top left; shape (4, 2)."""
        found, tags, _ = self._detector.detectMarkers(picture)
        if tags is None:
            return None
        for corners, tag in zip(found, np.ravel(tags), strict=True):
            if tag == self.scene.tag:
                return np.asarray(corners, np.float64).reshape(4, 2)
        return None
