"""Drawing scenes with OpenGL, on a GPU or in software, without a screen (EGL).

All views of a scan are drawn into one atlas and read back at once: for small pictures the calls
between processor and driver cost more than the pixels.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from relpose_ros.captures import shaders
from relpose_ros.errors import RelPoseError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import moderngl
    import numpy.typing as npt

    from relpose_ros.captures.objects import Part
    from relpose_ros.captures.scenes import Scene, Shot

    FloatArray = npt.NDArray[np.float64]

_NEAR, _FAR = 0.05, 400.0
_SHADOW_SIZE = 512
_SHADOW_REACH = 2.2
"""Half width of the shadow map, object radii."""
_CONTACT_SIZE = 64
_VERTEX_FLOATS = 11
_MIRROR_SIZE = 64
_UNITS = ("surfaces", "panorama", "mirrored", "shadow_map", "contact")
"""Texture units, in order."""
_GLOSSY = 0.02
"""Below it a part reflects nothing worth drawing."""


class RenderError(RelPoseError):
    """Pictures cannot be drawn here."""


@dataclass(frozen=True)
class Window:
    """The part of a full image that is drawn, pixels of the full image; outside the image it is black."""

    x0: float
    y0: float
    width: float
    height: float


class Renderer:
    """Owns an OpenGL context; use it from the thread that made it.

    Raises:
        RenderError: There is no EGL, or no OpenGL 3.3 behind it.
    """

    def __init__(self) -> None:
        import moderngl

        # Mesa's software renderer with threads of its own was seen to stall, and to crash, once in tens of
        # thousands of pictures. Without them it draws in this thread; who wants more starts more processes.
        os.environ.setdefault("LP_NUM_THREADS", "0")
        try:
            self._gl = moderngl.create_context(require=330, standalone=True, backend="egl")  # type: ignore[arg-type]
        except Exception as err:  # glcontext raises bare Exception and ValueError alike
            text = (
                f"no OpenGL 3.3 through EGL here ({err}). On Debian and Ubuntu: apt-get install libegl1 "
                "libgl1-mesa-dri, which also draws in software where there is no GPU."
            )
            raise RenderError(text) from err
        gl = self._gl
        self._surfaces: dict[tuple[str, ...], moderngl.Program] = {}
        self._backdrop = gl.program(shaders.BACKDROP_VERTEX, shaders.BACKDROP_FRAGMENT)
        self._place = gl.program(shaders.PLAIN_VERTEX, shaders.PLACE_FRAGMENT)
        self._depth = gl.program(shaders.PLAIN_VERTEX, shaders.EMPTY_FRAGMENT)
        _set(self._backdrop, "panorama", _UNITS.index("panorama"))
        quad = np.array([[-1, -1], [3, -1], [-1, 3]], np.float32)
        self._everywhere = gl.vertex_array(self._backdrop, [(gl.buffer(quad.tobytes()), "2f", "corner")])
        self._shadow_map = gl.depth_texture((_SHADOW_SIZE, _SHADOW_SIZE))
        self._shadow_map.compare_func = "<="
        self._shadow_map.repeat_x = self._shadow_map.repeat_y = False
        self._shadow_frame = gl.framebuffer([], self._shadow_map)
        self._atlases: dict[tuple[int, int, str], moderngl.Framebuffer] = {}

    @property
    def device(self) -> str:
        """What draws: the driver's own name for it."""
        return str(self._gl.info["GL_RENDERER"])

    def draw(
        self,
        scene: Scene,
        windows: Sequence[Window],
        size: tuple[int, int],
        *,
        supersampling: float = 2.0,
        sharpness: float = 0.0,
    ) -> npt.NDArray[np.uint8]:
        """Draw one window of each shot.

        Args:
            scene: What is seen.
            windows: One per shot.
            size: Width and height of each picture, pixels.
            supersampling: Drawn so many times larger along each side, then averaged.
            sharpness: Added to the texture level of detail: below 0 sharper than it should be.

        Returns:
            (N, height, width, 4): RGB, and the object's coverage of the pixel, 0 to 255.
        """
        # A process may hold several contexts, of which one is current.
        with self._gl, self._uploaded(scene) as loaded:
            drawn = self._colours(scene, loaded, windows, _enlarged(size, supersampling), sharpness)
        return _shrunk(drawn, size)

    def draw_with_places(
        self,
        scene: Scene,
        windows: Sequence[Window],
        size: tuple[int, int],
        stride: int,
        *,
        supersampling: float = 2.0,
        sharpness: float = 0.0,
    ) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.float16]]:
        """As ``draw``, and where on the object each ``stride``-th pixel looks.

        Returns:
            The pictures, and (N, height // stride, width // stride, 3) object coordinates at the
            centres of cells of ``stride`` pixels, NaN off the object.
        """
        # A process may hold several contexts, of which one is current.
        with self._gl, self._uploaded(scene) as loaded:
            drawn = self._colours(scene, loaded, windows, _enlarged(size, supersampling), sharpness)
            places = self._places(scene, loaded, windows, (size[0] // stride, size[1] // stride))
        return _shrunk(drawn, size), places

    def _uploaded(self, scene: Scene) -> _Uploaded:
        return _Uploaded(self._gl, scene, self._surface, self._depth, self._place)

    def _surface(self, features: tuple[str, ...]) -> moderngl.Program:
        """The shader of parts with these features, compiled at first use."""
        if features not in self._surfaces:
            defines = "\n".join(f"#define {name}" for name in features)
            program = self._gl.program(
                shaders.SURFACE_VERTEX, shaders.SURFACE_FRAGMENT.replace("#define FEATURES", defines)
            )
            for unit, name in enumerate(_UNITS):
                _set(program, name, unit)
            self._surfaces[features] = program
        return self._surfaces[features]

    def _colours(
        self,
        scene: Scene,
        loaded: _Uploaded,
        windows: Sequence[Window],
        size: tuple[int, int],
        sharpness: float,
    ) -> npt.NDArray[np.uint8]:
        gl, around = self._gl, scene.surroundings
        columns, frame = self._atlas(len(scene.shots), size, "f1")
        loaded.textures.use(_UNITS.index("surfaces"))
        loaded.panorama.use(_UNITS.index("panorama"))
        loaded.mirrored.use(_UNITS.index("mirrored"))
        self._shadow_map.use(_UNITS.index("shadow_map"))
        loaded.contact.use(_UNITS.index("contact"))
        ambient = np.ascontiguousarray(loaded.ambient * around.ambient, np.float32).tobytes()
        programs = {batch.program for batch in loaded.batches}
        for program in programs:
            _set(program, "to_light", tuple(around.to_light))
            _set(program, "key", tuple(around.key))
            _set(program, "shadow", around.shadow)
            _set(program, "ground_z", around.ground_z)
            _set(program, "sharpness", sharpness)
            _send(program, "ambient", ambient)
        _set(self._backdrop, "room_half", tuple(around.room_half))
        _set(self._backdrop, "eye", tuple(around.eye))
        frame.use()
        frame.clear()
        shadowed: FloatArray | None = None
        for k, (shot, window) in enumerate(zip(scene.shots, windows, strict=True)):
            turned = shot.world_from_object
            if around.shadow > 0 and (shadowed is None or not np.array_equal(turned, shadowed)):
                shadow_from_world = self._cast_shadow(loaded, turned, around.to_light)
                for program in programs:
                    _write(program, "shadow_from_world", shadow_from_world)
                shadowed = turned
                frame.use()
            corner = (k % columns * size[0], k // columns * size[1])
            gl.viewport = (*corner, *size)
            gl.scissor = _inside(shot, window, size, corner)
            camera_from_world = shot.camera_from_world
            centre = -camera_from_world[:, :3].T @ camera_from_world[:, 3]
            clip_from_world = _clip_from_camera(shot, window) @ _homogeneous(camera_from_world)
            for program in programs:
                _write(program, "clip_from_world", clip_from_world)
                _write(program, "object_from_world", turned.T)
                _set(program, "camera", tuple(centre))
            gl.enable(gl.DEPTH_TEST)
            gl.depth_func = "<"
            for batch in loaded.batches:
                _write(batch.program, "world_from_local", turned if batch.turning else np.eye(3))
                batch.vertices.render(vertices=batch.count, first=batch.first)
            gl.depth_func = "<="
            self._draw_backdrop(scene, shot, window, size[0], sharpness)
        gl.scissor = None
        return _cut(
            np.frombuffer(frame.read(components=4), np.uint8), frame.size, len(windows), columns, size, 4
        )

    def _draw_backdrop(self, scene: Scene, shot: Shot, window: Window, width: int, sharpness: float) -> None:
        program, k, around = self._backdrop, shot.intrinsics, scene.surroundings
        camera_from_world = shot.camera_from_world
        rays = np.array(
            [
                [window.width / 2 / k.fx, 0, (window.x0 + window.width / 2 - k.cx) / k.fx],
                [0, window.height / 2 / k.fy, (window.y0 + window.height / 2 - k.cy) / k.fy],
                [0, 0, 1],
            ]
        )
        _write(program, "ray_from_pixel", camera_from_world[:, :3].T @ rays)
        _set(program, "camera", tuple(-camera_from_world[:, :3].T @ camera_from_world[:, 3]))
        # The seam of the panorama would upset the driver's own choice of level.
        texels = around.panorama.shape[1] * window.width / width / k.fx / (2 * np.pi)
        level = np.log2(max(texels, 1.0)) + sharpness + around.backdrop_blur
        _set(program, "level", float(max(level, 0.0)))
        self._everywhere.render(vertices=3)

    def _places(
        self, scene: Scene, loaded: _Uploaded, windows: Sequence[Window], size: tuple[int, int]
    ) -> npt.NDArray[np.float16]:
        gl = self._gl
        columns, frame = self._atlas(len(scene.shots), size, "f4")
        frame.use()
        frame.clear()
        gl.enable(gl.DEPTH_TEST)
        gl.depth_func = "<"
        for k, (shot, window) in enumerate(zip(scene.shots, windows, strict=True)):
            corner = (k % columns * size[0], k // columns * size[1])
            gl.viewport = (*corner, *size)
            gl.scissor = _inside(shot, window, size, corner)
            clip = _clip_from_camera(shot, window)
            object_clip = clip @ _homogeneous(shot.camera_from_object)
            world_clip = clip @ _homogeneous(shot.camera_from_world)
            for (first, count), matrix, is_object in (
                (loaded.thing, object_clip, 1.0),
                (loaded.ground, object_clip if scene.surroundings.ground_turns else world_clip, 0.0),
                (loaded.clutter, world_clip, 0.0),
            ):
                _write(self._place, "clip_from_local", matrix)
                _set(self._place, "is_object", is_object)
                loaded.places.render(vertices=count, first=first)
        gl.scissor = None
        raw = np.frombuffer(frame.read(components=4, dtype="f4"), np.float32)
        cells = _cut(raw, frame.size, len(windows), columns, size, 4)
        return np.where(cells[..., 3:] > 0.5, cells[..., :3], np.nan).astype(np.float16)

    def _cast_shadow(
        self, loaded: _Uploaded, world_from_object: FloatArray, to_light: FloatArray
    ) -> FloatArray:
        """Draw the shadow map and return its texture coordinates from world ones, (4, 4)."""
        gl = self._gl
        self._shadow_frame.use()
        self._shadow_frame.clear(depth=1.0)
        gl.enable(gl.DEPTH_TEST)
        gl.depth_func = "<"
        side = np.cross(to_light, np.eye(3)[int(np.argmin(np.abs(to_light)))])
        side /= np.linalg.norm(side)
        axes = np.stack([side, np.cross(to_light, side), -to_light])
        light_from_world = np.eye(4)
        light_from_world[:3, :3] = axes / np.array([[_SHADOW_REACH], [_SHADOW_REACH], [4 * _SHADOW_REACH]])
        turned = np.eye(4)
        turned[:3, :3] = world_from_object
        _write(self._depth, "clip_from_local", light_from_world @ turned)
        loaded.depths.render(vertices=loaded.thing[1], first=loaded.thing[0])
        if loaded.clutter[1]:
            _write(self._depth, "clip_from_local", light_from_world)
            loaded.depths.render(vertices=loaded.clutter[1], first=loaded.clutter[0])
        texture_from_clip = np.diag([0.5, 0.5, 0.5, 1.0])
        texture_from_clip[:3, 3] = 0.5
        return np.asarray(texture_from_clip @ light_from_world)

    def _atlas(self, count: int, size: tuple[int, int], dtype: str) -> tuple[int, moderngl.Framebuffer]:
        """Columns of the atlas, and a frame that holds ``count`` pictures."""
        columns = int(np.ceil(np.sqrt(count)))
        whole = (columns * size[0], -(-count // columns) * size[1])
        key = (*whole, dtype)
        if key not in self._atlases:
            colour = self._gl.texture(whole, 4, dtype=dtype)
            self._atlases[key] = self._gl.framebuffer([colour], self._gl.depth_renderbuffer(whole))
        return columns, self._atlases[key]


@dataclass(frozen=True, eq=False)
class _Batch:
    """Triangles that one call draws."""

    program: moderngl.Program
    vertices: moderngl.VertexArray
    first: int
    count: int
    turning: bool
    """Whether they move with the object."""


class _Uploaded:
    """A scene's meshes and textures on the device, released on leaving."""

    def __init__(
        self,
        gl: moderngl.Context,
        scene: Scene,
        surface: Callable[[tuple[str, ...]], moderngl.Program],
        depth: moderngl.Program,
        place: moderngl.Program,
    ) -> None:
        around = scene.surroundings
        # The object first: what it hides of the rest is then never shaded.
        ground = () if around.ground is None else (around.ground,)
        groups = [scene.thing.parts, ground, around.clutter]
        turning = (True, around.ground_turns, False)
        features = [
            [_features(part, around.shadow > 0, k == 0) for part in group] for k, group in enumerate(groups)
        ]
        parts: list[Part] = []
        batches: list[tuple[moderngl.Program, int, int, bool]] = []
        runs: list[tuple[int, int]] = []
        for k, group in enumerate(groups):
            start = sum(part.mesh.triangles.size for part in parts)
            for feature in sorted(set(features[k])):
                alike = [part for part, own in zip(group, features[k], strict=True) if own == feature]
                first = sum(part.mesh.triangles.size for part in parts)
                parts += alike
                count = sum(part.mesh.triangles.size for part in alike)
                batches.append((surface(feature), first, count, turning[k]))
            runs.append((start, sum(part.mesh.triangles.size for part in parts) - start))
        self.thing, self.ground, self.clutter = runs
        size = max(256, max(part.texture.shape[0] for part in parts))
        layers = np.stack([_square(part.texture, size) for part in parts])
        self.textures = gl.texture_array((size, size, len(layers)), 3, layers.tobytes())
        self.textures.build_mipmaps()
        panorama = np.ascontiguousarray(around.panorama)
        self.panorama = gl.texture((panorama.shape[1], panorama.shape[0]), 3, panorama.tobytes())
        self.panorama.build_mipmaps()
        self.panorama.repeat_y = False
        self.ambient = _ambient(panorama)
        self.mirrored = gl.texture((_MIRROR_SIZE, _MIRROR_SIZE), 3, _octahedral(panorama).tobytes())
        self.mirrored.build_mipmaps()
        self.contact = gl.texture((_CONTACT_SIZE, _CONTACT_SIZE), 1, _contact(scene).tobytes())
        self.contact.repeat_x = self.contact.repeat_y = False
        vertices, triangles = _interleaved(parts)
        self._vertices = gl.buffer(vertices.tobytes())
        self._triangles = gl.buffer(triangles.tobytes())
        colour_layout = (self._vertices, "3f 3f 2f 3f", "position", "normal", "uv", "material")
        place_layout = (self._vertices, f"3f {4 * (_VERTEX_FLOATS - 3)}x", "position")
        arrays = {batch[0]: self._array(gl, batch[0], colour_layout) for batch in batches}
        self.batches = [
            _Batch(program, arrays[program], first, count, turns) for program, first, count, turns in batches
        ]
        self.depths = self._array(gl, depth, place_layout)
        self.places = self._array(gl, place, place_layout)

    def _array(
        self, gl: moderngl.Context, program: moderngl.Program, layout: tuple[Any, ...]
    ) -> moderngl.VertexArray:
        return gl.vertex_array(program, [layout], self._triangles)

    def __enter__(self) -> _Uploaded:
        return self

    def __exit__(self, *_: object) -> None:
        for array in {self.depths, self.places, *(batch.vertices for batch in self.batches)}:
            array.release()
        for buffer in (self._vertices, self._triangles):
            buffer.release()
        for texture in (self.textures, self.panorama, self.mirrored, self.contact):
            texture.release()


def _features(part: Part, shadows: bool, is_object: bool) -> tuple[str, ...]:
    wanted = {
        "OBJECT": is_object,
        "SHADOW": shadows,
        "GLOSS": part.gloss > _GLOSSY,
        "RELIEF": part.relief > 0,
    }
    return tuple(name for name, needed in wanted.items() if needed)


def _ambient(panorama: npt.NDArray[np.uint8]) -> FloatArray:
    """(9, 3) coefficients of the light that a white surface receives from all around, by its normal.

    Second-order spherical harmonics (Ramamoorthi and Hanrahan 2001) with their constants multiplied
    out, in the order of the shader.
    """
    small = cv2.resize(panorama, (32, 16), interpolation=cv2.INTER_AREA).astype(np.float64) / 255
    polar = (np.arange(16) + 0.5) * np.pi / 16
    azimuth = (np.arange(32) + 0.5) * np.pi / 16 - np.pi
    z = np.broadcast_to(np.cos(polar)[:, None], (16, 32))
    x, y = np.sin(polar)[:, None] * np.cos(azimuth), np.sin(polar)[:, None] * np.sin(azimuth)
    solid_angle = np.sin(polar)[:, None, None] * (np.pi / 16) ** 2
    basis = np.stack([np.ones_like(x), y, z, x, x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y])
    squared = np.array([1, 3, 3, 3, 15, 15, 1.25, 15, 3.75]) / (4 * np.pi)
    kernel = np.array([1] + [2 / 3] * 3 + [1 / 4] * 5)
    moments = np.einsum("kij,ijc->kc", basis, small * small * solid_angle)
    return np.asarray(moments * (squared * kernel)[:, None])


def _octahedral(panorama: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """The panorama on the unfolded octahedron: a direction is looked up without trigonometry."""
    grid = (np.arange(_MIRROR_SIZE) + 0.5) / _MIRROR_SIZE * 2 - 1
    x, y = np.meshgrid(grid, grid)
    z = 1 - np.abs(x) - np.abs(y)
    fold = z < 0
    x, y = (
        np.where(fold, (1 - np.abs(y)) * np.where(x < 0, -1, 1), x),
        np.where(fold, (1 - np.abs(x)) * np.where(y < 0, -1, 1), y),
    )
    length = np.sqrt(x * x + y * y + z * z)
    small = cv2.resize(panorama, (256, 128), interpolation=cv2.INTER_AREA)
    column = (np.arctan2(y, x) / (2 * np.pi) + 0.5) * 256 - 0.5
    row = np.arccos(z / length) / np.pi * 128 - 0.5
    seen = cv2.remap(
        small,
        column.astype(np.float32),
        row.astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return np.ascontiguousarray(seen)


def _interleaved(parts: Sequence[Part]) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.uint32]]:
    """(V, 11) position, normal, uv, layer, gloss, relief; and the vertex indices of all triangles."""
    vertices, triangles, start = [], [], 0
    for layer, part in enumerate(parts):
        mesh = part.mesh
        block = np.empty((len(mesh.positions), _VERTEX_FLOATS), np.float32)
        block[:, :3], block[:, 3:6], block[:, 6:8] = mesh.positions, mesh.normals, mesh.uvs
        block[:, 8:] = layer, part.gloss, part.relief
        vertices.append(block)
        triangles.append((mesh.triangles + start).astype(np.uint32).reshape(-1))
        start += len(block)
    return np.concatenate(vertices), np.concatenate(triangles)


def _square(texture: npt.NDArray[np.uint8], size: int) -> npt.NDArray[np.uint8]:
    if texture.shape[:2] == (size, size):
        return texture
    return np.asarray(cv2.resize(texture, (size, size), interpolation=cv2.INTER_LINEAR), np.uint8)


def _contact(scene: Scene) -> npt.NDArray[np.uint8]:
    """How much of the sky the object hides from the ground beneath it, seen from above, (64, 64)."""
    if scene.surroundings.ground is None:
        return np.zeros((_CONTACT_SIZE, _CONTACT_SIZE), np.uint8)
    dark = np.zeros((_CONTACT_SIZE, _CONTACT_SIZE), np.float32)
    rng = np.random.default_rng(0)
    for part in scene.thing.parts:
        corners = part.mesh.positions[part.mesh.triangles]
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        if area.sum() <= 0:
            continue
        chosen = corners[
            np.searchsorted(np.cumsum(area) / area.sum(), rng.random(1500)).clip(0, len(area) - 1)
        ]
        weight = rng.dirichlet((1, 1, 1), 1500)[..., None]
        points = (chosen * weight).sum(1)
        cell = (
            ((points[:, :2] / (2 * shaders.CONTACT_REACH) + 0.5) * _CONTACT_SIZE)
            .astype(int)
            .clip(0, _CONTACT_SIZE - 1)
        )
        near = np.exp(-(points[:, 2] - scene.surroundings.ground_z) * 5)
        np.maximum.at(dark, (cell[:, 1], cell[:, 0]), near.astype(np.float32))
    blurred = cv2.GaussianBlur(cv2.dilate(dark, np.ones((3, 3))), (0, 0), 2.0)
    return np.asarray(np.clip(blurred * 1.2, 0, 1) * 255, np.uint8)


def _clip_from_camera(shot: Shot, window: Window) -> FloatArray:
    """Projection of the window, its first row at the bottom of the viewport: read back, it is on top."""
    k = shot.intrinsics
    matrix = np.zeros((4, 4))
    matrix[0, 0] = 2 * k.fx / window.width
    matrix[1, 1] = 2 * k.fy / window.height
    matrix[0, 2] = 2 * (k.cx - window.x0) / window.width - 1
    matrix[1, 2] = 2 * (k.cy - window.y0) / window.height - 1
    matrix[2, 2] = (_FAR + _NEAR) / (_FAR - _NEAR)
    matrix[2, 3] = -2 * _FAR * _NEAR / (_FAR - _NEAR)
    matrix[3, 2] = 1
    return matrix


def _inside(
    shot: Shot, window: Window, size: tuple[int, int], corner: tuple[int, int]
) -> tuple[int, int, int, int]:
    """The part of the viewport that shows the image: beyond its border there is nothing to see."""
    left = max(0, round(-window.x0 / window.width * size[0]))
    top = max(0, round(-window.y0 / window.height * size[1]))
    right = min(size[0], round((shot.width - window.x0) / window.width * size[0]))
    bottom = min(size[1], round((shot.height - window.y0) / window.height * size[1]))
    return corner[0] + left, corner[1] + top, max(right - left, 0), max(bottom - top, 0)


def _cut(
    flat: npt.NDArray[Any],
    whole: tuple[int, int],
    count: int,
    columns: int,
    size: tuple[int, int],
    channels: int,
) -> npt.NDArray[Any]:
    """The atlas as (count, height, width, channels)."""
    width, height = size
    grid = flat.reshape(whole[1] // height, height, columns, width, channels)
    return np.ascontiguousarray(grid.swapaxes(1, 2)).reshape(-1, height, width, channels)[:count]


def _enlarged(size: tuple[int, int], factor: float) -> tuple[int, int]:
    return round(size[0] * factor), round(size[1] * factor)


def _shrunk(pictures: npt.NDArray[np.uint8], size: tuple[int, int]) -> npt.NDArray[np.uint8]:
    """(N, H, W, 4) averaged down to size (width, height)."""
    if pictures.shape[2:0:-1] == size:
        return pictures
    return np.stack([cv2.resize(picture, size, interpolation=cv2.INTER_AREA) for picture in pictures])


def _homogeneous(transform: FloatArray) -> FloatArray:
    return np.vstack([transform, [0, 0, 0, 1]])


def _set(program: Any, name: str, value: object) -> None:
    if name in program:
        program[name].value = value


def _write(program: Any, name: str, matrix: FloatArray) -> None:
    _send(program, name, np.ascontiguousarray(matrix.T, np.float32).tobytes())


def _send(program: Any, name: str, data: bytes) -> None:
    if name in program:
        program[name].write(data)
