"""Pictures of the hand: offscreen, no window and no display needed.

On Linux the OpenGL context is EGL's, unless MUJOCO_GL names another way (`osmesa`, `glfw`).  MuJoCo itself reads that
variable when it is imported, so the context is made here, whoever imported MuJoCo first.
"""

from __future__ import annotations

import os
import struct
import sys
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from hannes_description.errors import HannesError
from hannes_description.joints import JOINT_LIMITS, JOINT_NAMES
from hannes_description.mjcf import Variant, build_spec
from hannes_description.parameters import ParameterSet
from numpy.typing import NDArray

from .objects import GraspObject

Image = NDArray[np.uint8]

OPEN: NDArray[np.float64] = np.zeros(len(JOINT_NAMES))
"""Joint positions (13,) of the open hand."""

CLOSED: NDArray[np.float64] = np.array(
    [
        0.0 if name.endswith("_abd") and not name.startswith("thumb") else JOINT_LIMITS[name].upper
        for name in JOINT_NAMES
    ]
)
"""Joint positions (13,) of the closed hand."""

VIEWS: Mapping[str, tuple[float, float, float, tuple[float, float, float]]] = {
    "palm": (203.0, -10.0, 0.30, (0.012, 0.002, 0.074)),
    "side": (264.0, -8.0, 0.30, (0.024, 0.0, 0.074)),
    "thumb": (230.0, -16.0, 0.30, (0.022, 0.004, 0.074)),
}
"""Cameras by name: azimuth and elevation in degrees, distance in m, the point looked at in m."""


def _context(width: int, height: int) -> Any:
    """An offscreen OpenGL context of the chosen kind."""
    kind = os.environ.get("MUJOCO_GL", "").lower().strip()
    if kind == "osmesa":
        from mujoco.osmesa import GLContext
    elif kind in ("", "egl") and sys.platform.startswith("linux"):
        from mujoco.egl import GLContext
    else:
        from mujoco.gl_context import GLContext
    return GLContext(width, height)


class HandRenderer:
    """Draws one hand; keep it for many pictures (making it costs 0.2 s, a picture about 50 ms).

    parameters  of the model; variant as in hannes_description.mjcf; grasp an object to draw, or None
    width, height  pixels
    """

    def __init__(
        self,
        parameters: ParameterSet,
        variant: Variant | Mapping[str, object] | None = None,
        grasp: GraspObject | None = None,
        *,
        width: int = 800,
        height: int = 800,
    ) -> None:
        spec = build_spec(parameters, variant, grasp)
        spec.visual.global_.offwidth, spec.visual.global_.offheight = width, height
        spec.visual.quality.offsamples = 4
        spec.visual.quality.shadowsize = 2048
        spec.visual.headlight.ambient = [0.32, 0.32, 0.34]
        spec.visual.headlight.diffuse = [0.38, 0.38, 0.38]
        spec.visual.headlight.specular = [0.25, 0.25, 0.25]
        spec.visual.map.znear, spec.visual.map.zfar = 0.02, 30.0
        spec.add_texture(
            name="sky",
            type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
            width=64,
            height=384,
            builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
            rgb1=[0.97, 0.975, 0.98],
            rgb2=[0.80, 0.83, 0.87],
        )
        for place, direction, strength in (
            ((0.4, 0.5, 0.6), (-0.5, -0.6, -0.7), 0.55),
            ((0.5, -0.4, 0.2), (-0.7, 0.6, -0.2), 0.25),
        ):
            spec.worldbody.add_light(
                pos=list(place),
                dir=list(direction),
                diffuse=[strength] * 3,
                specular=[0.4 * strength] * 3,
                type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
                castshadow=strength > 0.5,
            )
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self._addresses = [int(self.model.joint(name).qposadr[0]) for name in JOINT_NAMES]
        self._context: Any = None
        self._canvas: Any = None
        try:
            self._context = _context(width, height)
            self._context.make_current()
            self._canvas = mujoco.MjrContext(self.model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        except Exception as error:  # the OpenGL back ends raise types of their own
            self.close()
            raise HannesError(
                f"No offscreen OpenGL for pictures ({type(error).__name__}: {error}); install libegl1 or "
                "set MUJOCO_GL=osmesa."
            ) from error
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._canvas)
        self._scene = mujoco.MjvScene(self.model, maxgeom=500)
        self._size = mujoco.MjrRect(0, 0, width, height)
        self._options = mujoco.MjvOption()
        self._options.flags[mujoco.mjtVisFlag.mjVIS_TENDON] = False
        self._options.sitegroup[:] = 0

    def draw(self, joint_positions: NDArray[np.float64], view: str = "thumb") -> Image:
        """A picture (height, width, 3) of the hand at joint positions (13,) in rad."""
        if view not in VIEWS:
            raise HannesError(f"Unknown view '{view}'; valid are {', '.join(VIEWS)}.")
        positions = np.asarray(joint_positions, dtype=np.float64)
        if positions.shape != (len(JOINT_NAMES),) or not np.all(np.isfinite(positions)):
            raise HannesError(
                f"A picture needs {len(JOINT_NAMES)} finite joint positions, not an array of shape "
                f"{positions.shape}."
            )
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[self._addresses] = positions
        mujoco.mj_forward(self.model, self.data)
        azimuth, elevation, distance, lookat = VIEWS[view]
        camera = mujoco.MjvCamera()
        camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        camera.azimuth, camera.elevation, camera.distance = azimuth, elevation, distance
        camera.lookat[:] = lookat
        image = np.empty((self._size.height, self._size.width, 3), dtype=np.uint8)
        self._context.make_current()  # another renderer may have drawn since
        mujoco.mjv_updateScene(
            self.model, self.data, self._options, None, camera, mujoco.mjtCatBit.mjCAT_ALL.value, self._scene
        )
        mujoco.mjr_render(self._size, self._scene, self._canvas)
        mujoco.mjr_readPixels(image, None, self._size, self._canvas)
        return np.flipud(image).copy()

    def close(self) -> None:
        """Free the OpenGL context."""
        if self._context is not None:
            self._context.make_current()
            if self._canvas is not None:
                self._canvas.free()
            self._context.free()
            self._context = None

    def __enter__(self) -> HandRenderer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def side_by_side(images: list[Image]) -> Image:
    """Pictures of equal height in a row, as one (height, sum of widths, 3)."""
    return np.concatenate(images, axis=1)


def save_png(image: Image, path: str | Path) -> Path:
    """Write an image (height, width, 3) of uint8 as PNG, with the standard library alone."""
    image = np.ascontiguousarray(image, dtype=np.uint8)
    if image.ndim != 3 or image.shape[2] != 3:
        raise HannesError(f"A picture must have the shape (height, width, 3), not {image.shape}.")
    height, width = image.shape[:2]

    def chunk(kind: bytes, content: bytes) -> bytes:
        return (
            struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))
        )

    rows = np.concatenate([np.zeros((height, 1), dtype=np.uint8), image.reshape(height, 3 * width)], axis=1)
    content = (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
        + chunk(b"IDAT", zlib.compress(rows.tobytes(), 6))
        + chunk(b"IEND", b"")
    )
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    except OSError as error:
        raise HannesError(f"Cannot write the picture '{path}': {error}.") from error
    return path
