"""Cameras on the ego, rendered without a window: pictures and metric depth in one pass."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, Self

import numpy as np
import numpy.typing as npt

from looktwice.clients.metadrive import simulator
from looktwice.model.driving.cameras import FRONT_CAMERAS, CameraSpec
from looktwice.model.driving.images import encode_jpeg

NEAR_M: Final = 0.3
FAR_M: Final = 320.0


@dataclass(frozen=True, eq=False)
class RenderedPicture:
    """One camera's view: JPEG bytes, and float32 [h, w] metric depth along the axis (inf for the sky)."""

    camera: str
    jpeg: bytes
    depth_m: npt.NDArray[np.float32]


class Rig:
    """A set of off-screen cameras over one scene graph, kept for the life of a process."""

    def __init__(self, specs: tuple[CameraSpec, ...] = FRONT_CAMERAS) -> None:
        core = simulator.panda()
        self.specs = specs
        self.root = core.NodePath("world")
        self._engine = core.GraphicsEngine.getGlobalPtr()
        self._pipe = core.GraphicsPipeSelection.getGlobalPtr().makeDefaultPipe()
        if self._pipe is None:
            raise simulator.SimulatorMissing(
                "no EGL graphics pipe: install the system's EGL libraries (libegl1)"
            )
        self._host: Any = None
        self.ego = self.root.attachNewNode("ego")
        self._cameras = [self._camera(spec) for spec in specs]

    @classmethod
    def of_width(cls, width_px: int) -> Self:
        """The front cameras; pictures of another size than a model's are stretched, and it sees less."""
        return cls(tuple(camera.resized(width_px) for camera in FRONT_CAMERAS))

    def _camera(self, spec: CameraSpec) -> tuple[Any, Any, Any]:
        core = simulator.panda()
        wanted = core.FrameBufferProperties()
        wanted.setRgbaBits(8, 8, 8, 8)
        wanted.setDepthBits(24)
        size = core.WindowProperties.size(spec.width, spec.height)
        arguments = [self._pipe, spec.name, 0, wanted, size, core.GraphicsPipe.BFRefuseWindow]
        if self._host is not None:
            arguments += [self._host.getGsg(), self._host]
        buffer = self._engine.makeOutput(*arguments)
        if buffer is None:
            raise simulator.SimulatorMissing(
                "no off-screen buffer could be made: install the system's EGL libraries"
            )
        self._host = self._host or buffer
        colour, depth = core.Texture(f"{spec.name}-colour"), core.Texture(f"{spec.name}-depth")
        depth.setFormat(core.Texture.FDepthComponent32)
        depth.setComponentType(core.Texture.TFloat)
        output = core.GraphicsOutput
        buffer.addRenderTexture(colour, output.RTMCopyRam, output.RTPColor)
        buffer.addRenderTexture(depth, output.RTMCopyRam, output.RTPDepth)
        buffer.setClearColorActive(True)
        lens = core.PerspectiveLens()
        lens.setFilmSize(spec.width, spec.height)
        lens.setFocalLength(spec.focal_px)
        lens.setNearFar(NEAR_M, FAR_M)
        lens.setFilmOffset(0.0, (spec.horizon - 0.5) * spec.height)
        node = core.Camera(spec.name, lens)
        node.setScene(self.root)
        holder = self.ego.attachNewNode(node)
        holder.setPos(spec.forward_m, spec.left_m, spec.up_m)
        holder.setH(spec.heading_degrees - 90.0)
        buffer.makeDisplayRegion().setCamera(holder)
        return buffer, colour, depth

    def set_sky(self, colour: tuple[float, float, float]) -> None:
        """The colour behind everything."""
        for buffer, _, _ in self._cameras:
            buffer.setClearColor((*colour, 1.0))

    def shoot(self) -> list[RenderedPicture]:
        """Render all cameras from where the ego stands."""
        self._engine.renderFrame()
        pictures = []
        for spec, (_, colour, depth) in zip(self.specs, self._cameras, strict=True):
            shape = (spec.height, spec.width)
            image = np.frombuffer(colour.getRamImageAs("RGB"), np.uint8).reshape(*shape, 3)[::-1]
            raw = np.frombuffer(memoryview(depth.getRamImage()), np.float32).reshape(shape)[::-1]
            linear = NEAR_M * FAR_M / (FAR_M - raw.astype(np.float64) * (FAR_M - NEAR_M))
            metres = np.where(raw >= 0.999999, np.inf, linear).astype(np.float32)
            pictures.append(RenderedPicture(spec.name, encode_jpeg(image), metres))
        return pictures

    def close(self) -> None:
        """Give the off-screen buffers back."""
        for buffer, _, _ in self._cameras:
            self._engine.removeWindow(buffer)
        self._cameras = []
