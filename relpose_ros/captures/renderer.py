"""Drawing scenes with OpenGL, on a GPU or in software, without a screen (EGL).

All views of a scan are drawn into one atlas and read back at once: for small pictures the calls
between processor and driver cost more than the pixels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from relpose_ros.errors import RelPoseError

if TYPE_CHECKING:
    from collections.abc import Sequence

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
_CONTACT_REACH = 1.7
_VERTEX_FLOATS = 11

_SURFACE_VERTEX = """
#version 330
uniform mat4 clip_from_world;
uniform mat3 world_from_local;
in vec3 position;
in vec3 normal;
in vec2 uv;
in vec3 material;
out vec3 world;
out vec3 turned;
out vec3 texel;
out vec2 finish;
void main() {
    world = world_from_local * position;
    turned = world_from_local * normal;
    texel = vec3(uv, material.x);
    finish = material.yz;
    gl_Position = clip_from_world * vec4(world, 1.0);
}
"""

# Colours are squared on the way in and rooted on the way out: near enough to the sRGB curve.
_SURFACE_FRAGMENT = """
#version 330
const float PI = 3.14159265;
uniform sampler2DArray surfaces;
uniform sampler2D panorama;
uniform sampler2DShadow shadow_map;
uniform sampler2D contact;
uniform mat4 shadow_from_world;
uniform mat3 object_from_world;
uniform vec3 camera;
uniform vec3 to_light;
uniform vec3 key;
uniform float ambient;
uniform float shadow;
uniform float ground_z;
uniform float is_object;
uniform float sharpness;
uniform float panorama_levels;
in vec3 world;
in vec3 turned;
in vec3 texel;
in vec2 finish;
out vec4 colour;

vec3 light_from(vec3 direction, float level) {
    vec2 place = vec2(atan(direction.y, direction.x) / (2.0 * PI) + 0.5, acos(clamp(direction.z, -1.0, 1.0)) / PI);
    vec3 seen = textureLod(panorama, place, level).rgb;
    return seen * seen;
}

void main() {
    vec3 base = texture(surfaces, texel, sharpness).rgb;
    vec3 albedo = base * base;
    vec3 n = normalize(turned);
    vec3 eye = normalize(camera - world);
    if (dot(n, eye) < 0.0) n = -n;
    if (finish.y > 0.0) {
        float height = dot(base, vec3(0.33)) * finish.y;
        vec3 px = dFdx(world), py = dFdy(world);
        vec3 across = cross(py, n), down = cross(n, px);
        float area = dot(px, across);
        n = normalize(abs(area) * n - sign(area) * (dFdx(height) * across + dFdy(height) * down) + n * 1e-9);
    }
    float lit = max(dot(n, to_light), 0.0);
    if (shadow > 0.0) {
        vec3 place = (shadow_from_world * vec4(world + n * 0.02, 1.0)).xyz;
        float open = 0.0;
        for (int k = 0; k < 4; k++) {
            vec2 shift = vec2(k & 1, k >> 1) * 0.008 - 0.004;
            open += texture(shadow_map, vec3(place.xy + shift, place.z));
        }
        lit *= 1.0 - shadow * (1.0 - 0.25 * open);
    }
    vec3 diffuse = ambient * light_from(n, panorama_levels - 3.0);
    float above = world.z - ground_z;
    if (is_object < 0.5) {
        vec3 local = object_from_world * world;
        vec2 place = local.xy / (2.0 * CONTACT_REACH) + 0.5;
        float dark = texture(contact, place).r * exp(-max(above, 0.0) * 6.0);
        diffuse *= 1.0 - 0.85 * dark;
        lit *= 1.0 - 0.5 * dark;
    } else {
        // What is near the ground and faces it sees less of the room.
        diffuse *= 1.0 - 0.45 * exp(-max(above, 0.0) * 5.0) * (0.6 - 0.4 * n.z);
    }
    vec3 result = albedo * (key * lit + diffuse);
    if (finish.x > 0.02) {
        vec3 half_way = normalize(to_light + eye);
        float focus = exp2(3.0 + 6.0 * finish.x);
        float edge = 0.04 + 0.96 * pow(1.0 - max(dot(n, eye), 0.0), 5.0);
        result += key * lit * finish.x * pow(max(dot(n, half_way), 0.0), focus) * 0.8;
        result += finish.x * (0.08 + edge) * light_from(reflect(-eye, n), (1.0 - finish.x) * (panorama_levels - 3.0));
    }
    colour = vec4(sqrt(result / (1.0 + 0.25 * dot(result, vec3(0.33)))), is_object);
}
""".replace("CONTACT_REACH", str(_CONTACT_REACH))

_BACKDROP_VERTEX = """
#version 330
uniform mat3 ray_from_pixel;
in vec2 corner;
out vec3 ray;
void main() {
    ray = ray_from_pixel * vec3(corner, 1.0);
    gl_Position = vec4(corner, 1.0, 1.0);
}
"""

_BACKDROP_FRAGMENT = """
#version 330
const float PI = 3.14159265;
uniform sampler2D panorama;
uniform vec3 camera;
uniform vec3 room_half;
uniform vec3 eye;
uniform float level;
uniform float brightness;
in vec3 ray;
out vec4 colour;
void main() {
    vec3 way = normalize(ray) + vec3(1e-6);
    vec3 walls = (sign(way) * room_half - camera) / way;
    vec3 hit = normalize(camera + min(walls.x, min(walls.y, walls.z)) * way - eye);
    vec2 place = vec2(atan(hit.y, hit.x) / (2.0 * PI) + 0.5, acos(clamp(hit.z, -1.0, 1.0)) / PI);
    colour = vec4(textureLod(panorama, place, level).rgb * brightness, 0.0);
}
"""

_PLAIN_VERTEX = """
#version 330
uniform mat4 clip_from_local;
in vec3 position;
out vec3 local;
void main() {
    local = position;
    gl_Position = clip_from_local * vec4(position, 1.0);
}
"""

_PLACE_FRAGMENT = """
#version 330
uniform float is_object;
in vec3 local;
out vec4 place;
void main() { place = vec4(local, is_object); }
"""

_EMPTY_FRAGMENT = """
#version 330
void main() {}
"""


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

        try:
            self._gl = moderngl.create_context(require=330, standalone=True, backend="egl")
        except Exception as err:  # glcontext raises bare Exception and ValueError alike
            text = (
                f"no OpenGL 3.3 through EGL here ({err}). On Debian and Ubuntu: apt-get install libegl1 "
                "libgl1-mesa-dri, which also draws in software where there is no GPU."
            )
            raise RenderError(text) from err
        gl = self._gl
        self._surface = gl.program(_SURFACE_VERTEX, _SURFACE_FRAGMENT)
        self._backdrop = gl.program(_BACKDROP_VERTEX, _BACKDROP_FRAGMENT)
        self._place = gl.program(_PLAIN_VERTEX, _PLACE_FRAGMENT)
        self._depth = gl.program(_PLAIN_VERTEX, _EMPTY_FRAGMENT)
        for unit, name in enumerate(("surfaces", "panorama", "shadow_map", "contact")):
            _set(self._surface, name, unit)
        _set(self._backdrop, "panorama", 1)
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
        supersampling: int = 2,
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
        with _Uploaded(self._gl, scene, self._surface, self._depth, self._place) as loaded:
            drawn = self._colours(scene, loaded, windows, (size[0] * supersampling, size[1] * supersampling), sharpness)
        if supersampling == 1:
            return drawn
        return np.stack([cv2.resize(picture, size, interpolation=cv2.INTER_AREA) for picture in drawn])

    def draw_with_places(
        self,
        scene: Scene,
        windows: Sequence[Window],
        size: tuple[int, int],
        stride: int,
        *,
        supersampling: int = 2,
        sharpness: float = 0.0,
    ) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.float16]]:
        """As ``draw``, and where on the object each ``stride``-th pixel looks.

        Returns:
            The pictures, and (N, height // stride, width // stride, 3) object coordinates at the
            centres of cells of ``stride`` pixels, NaN off the object.
        """
        with _Uploaded(self._gl, scene, self._surface, self._depth, self._place) as loaded:
            drawn = self._colours(scene, loaded, windows, (size[0] * supersampling, size[1] * supersampling), sharpness)
            places = self._places(scene, loaded, windows, (size[0] // stride, size[1] // stride))
        if supersampling > 1:
            drawn = np.stack([cv2.resize(picture, size, interpolation=cv2.INTER_AREA) for picture in drawn])
        return drawn, places

    def _colours(
        self, scene: Scene, loaded: _Uploaded, windows: Sequence[Window], size: tuple[int, int], sharpness: float
    ) -> npt.NDArray[np.uint8]:
        gl, around, program = self._gl, scene.surroundings, self._surface
        columns, frame = self._atlas(len(scene.shots), size, "f1")
        levels = np.log2(around.panorama.shape[1])
        loaded.textures.use(0)
        loaded.panorama.use(1)
        self._shadow_map.use(2)
        loaded.contact.use(3)
        _set(program, "to_light", tuple(around.to_light))
        _set(program, "key", tuple(around.key))
        _set(program, "ambient", around.ambient)
        _set(program, "shadow", around.shadow)
        _set(program, "ground_z", -1e3 if around.ground_z is None else around.ground_z)
        _set(program, "sharpness", sharpness)
        _set(program, "panorama_levels", float(levels))
        _set(self._backdrop, "room_half", tuple(around.room_half))
        _set(self._backdrop, "eye", tuple(around.eye))
        _set(self._backdrop, "brightness", 1.0)
        frame.use()
        frame.clear()
        shadowed: FloatArray | None = None
        for k, (shot, window) in enumerate(zip(scene.shots, windows, strict=True)):
            turned = shot.world_from_object
            if around.shadow > 0 and (shadowed is None or not np.array_equal(turned, shadowed)):
                self._cast_shadow(loaded, turned, around.to_light)
                shadowed = turned
                frame.use()
            corner = (k % columns * size[0], k // columns * size[1])
            gl.viewport = (*corner, *size)
            gl.scissor = _inside(shot, window, size, corner)
            camera_from_world = shot.camera_from_world
            centre = -camera_from_world[:, :3].T @ camera_from_world[:, 3]
            clip = _clip_from_camera(shot, window)
            _write(program, "clip_from_world", clip @ _homogeneous(camera_from_world))
            _write(program, "object_from_world", turned.T)
            _set(program, "camera", tuple(centre))
            gl.enable(gl.DEPTH_TEST)
            gl.depth_func = "<"
            for part, local in ((loaded.thing, turned), (loaded.turning, turned), (loaded.standing, np.eye(3))):
                _write(program, "world_from_local", local)
                _set(program, "is_object", float(part is loaded.thing))
                loaded.colours.render(vertices=part[1], first=part[0])
            gl.depth_func = "<="
            pixel = window.width / size[0]
            rays = np.array(
                [
                    [window.width / 2, 0, window.x0 + window.width / 2 - shot.intrinsics.cx],
                    [0, window.height / 2, window.y0 + window.height / 2 - shot.intrinsics.cy],
                    [0, 0, shot.intrinsics.fx],
                ]
            )
            rays[1] *= shot.intrinsics.fx / shot.intrinsics.fy
            _write(self._backdrop, "ray_from_pixel", camera_from_world[:, :3].T @ rays)
            _set(self._backdrop, "camera", tuple(centre))
            angle = pixel / shot.intrinsics.fx
            level = np.log2(max(around.panorama.shape[1] * angle / (2 * np.pi), 1.0))
            _set(self._backdrop, "level", float(max(level + sharpness, 0.0)))
            self._everywhere.render(vertices=3)
        gl.scissor = None
        return _cut(np.frombuffer(frame.read(components=4), np.uint8), frame.size, len(windows), columns, size, 4)

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
            for part, matrix in (
                (loaded.thing, object_clip),
                (loaded.turning, object_clip),
                (loaded.standing, world_clip),
            ):
                _write(self._place, "clip_from_local", matrix)
                _set(self._place, "is_object", float(part is loaded.thing))
                loaded.places.render(vertices=part[1], first=part[0])
        gl.scissor = None
        raw = np.frombuffer(frame.read(components=4, dtype="f4"), np.float32)
        cells = _cut(raw, frame.size, len(windows), columns, size, 4)
        return np.where(cells[..., 3:] > 0.5, cells[..., :3], np.nan).astype(np.float16)

    def _cast_shadow(self, loaded: _Uploaded, world_from_object: FloatArray, to_light: FloatArray) -> None:
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
        _write(self._depth, "clip_from_local", light_from_world @ _homogeneous(np.column_stack([world_from_object, np.zeros(3)])))
        loaded.depths.render(vertices=loaded.thing[1], first=loaded.thing[0])
        _write(self._depth, "clip_from_local", light_from_world)
        # The ground comes first among the standing parts and casts no shadow.
        first, count = loaded.standing
        loaded.depths.render(vertices=count - loaded.ground_count, first=first + loaded.ground_count)
        texture_from_clip = np.diag([0.5, 0.5, 0.5, 1.0])
        texture_from_clip[:3, 3] = 0.5
        _write(self._surface, "shadow_from_world", texture_from_clip @ light_from_world)

    def _atlas(self, count: int, size: tuple[int, int], dtype: str) -> tuple[int, moderngl.Framebuffer]:
        """Columns of the atlas, and a frame that holds ``count`` pictures."""
        columns = int(np.ceil(np.sqrt(count)))
        whole = (columns * size[0], -(-count // columns) * size[1])
        if (*whole, dtype) not in self._atlases:
            colour = self._gl.texture(whole, 4, dtype=dtype)
            self._atlases[(*whole, dtype)] = self._gl.framebuffer([colour], self._gl.depth_renderbuffer(whole))
        return columns, self._atlases[(*whole, dtype)]


class _Uploaded:
    """A scene's meshes and textures on the device, released on leaving."""

    def __init__(self, gl: moderngl.Context, scene: Scene, colour: Any, depth: Any, place: Any) -> None:
        around = scene.surroundings
        groups = (scene.thing.parts, around.turning, around.standing)
        parts = [part for group in groups for part in group]
        counts = [sum(part.mesh.triangles.size for part in group) for group in groups]
        self.thing = (0, counts[0])
        self.turning = (counts[0], counts[1])
        self.standing = (counts[0] + counts[1], counts[2])
        grounded = around.ground_z is not None and not around.turning
        self.ground_count = around.standing[0].mesh.triangles.size if grounded else 0
        size = max(256, max(part.texture.shape[0] for part in parts))
        layers = np.stack([_square(part.texture, size) for part in parts])
        self.textures = gl.texture_array((size, size, len(layers)), 3, layers.tobytes())
        self.textures.build_mipmaps()
        self.textures.anisotropy = 4.0
        panorama = around.panorama
        self.panorama = gl.texture((panorama.shape[1], panorama.shape[0]), 3, np.ascontiguousarray(panorama).tobytes())
        self.panorama.build_mipmaps()
        self.panorama.repeat_y = False
        dark = _contact(scene)
        self.contact = gl.texture((_CONTACT_SIZE, _CONTACT_SIZE), 1, dark.tobytes())
        self.contact.repeat_x = self.contact.repeat_y = False
        vertices, triangles = _interleaved(parts)
        self._vertices = gl.buffer(vertices.tobytes())
        self._triangles = gl.buffer(triangles.tobytes())
        colour_layout = (self._vertices, "3f 3f 2f 3f", "position", "normal", "uv", "material")
        place_layout = (self._vertices, f"3f {4 * (_VERTEX_FLOATS - 3)}x", "position")
        self.colours = gl.vertex_array(colour, [colour_layout], self._triangles)
        self.depths = gl.vertex_array(depth, [place_layout], self._triangles)
        self.places = gl.vertex_array(place, [place_layout], self._triangles)

    def __enter__(self) -> _Uploaded:
        return self

    def __exit__(self, *_: object) -> None:
        for thing in (self.colours, self.depths, self.places, self._vertices, self._triangles):
            thing.release()
        for texture in (self.textures, self.panorama, self.contact):
            texture.release()


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
    ground = scene.surroundings.ground_z
    if ground is None:
        return np.zeros((_CONTACT_SIZE, _CONTACT_SIZE), np.uint8)
    dark = np.zeros((_CONTACT_SIZE, _CONTACT_SIZE), np.float32)
    rng = np.random.default_rng(0)
    for part in scene.thing.parts:
        corners = part.mesh.positions[part.mesh.triangles]
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        if area.sum() <= 0:
            continue
        chosen = corners[np.searchsorted(np.cumsum(area) / area.sum(), rng.random(1500)).clip(0, len(area) - 1)]
        weight = rng.dirichlet((1, 1, 1), 1500)[..., None]
        points = (chosen * weight).sum(1)
        cell = ((points[:, :2] / (2 * _CONTACT_REACH) + 0.5) * _CONTACT_SIZE).astype(int).clip(0, _CONTACT_SIZE - 1)
        near = np.exp(-(points[:, 2] - ground) * 5)
        np.maximum.at(dark, (cell[:, 1], cell[:, 0]), near.astype(np.float32))
    dark = cv2.GaussianBlur(cv2.dilate(dark, np.ones((3, 3))), (0, 0), 2.0)
    return np.asarray(np.clip(dark * 1.2, 0, 1) * 255, np.uint8)


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


def _inside(shot: Shot, window: Window, size: tuple[int, int], corner: tuple[int, int]) -> tuple[int, int, int, int]:
    """The part of the viewport that shows the image: beyond its border there is nothing to see."""
    left = max(0, round(-window.x0 / window.width * size[0]))
    top = max(0, round(-window.y0 / window.height * size[1]))
    right = min(size[0], round((shot.width - window.x0) / window.width * size[0]))
    bottom = min(size[1], round((shot.height - window.y0) / window.height * size[1]))
    return corner[0] + left, corner[1] + top, max(right - left, 0), max(bottom - top, 0)


def _cut(
    flat: npt.NDArray[Any], whole: tuple[int, int], count: int, columns: int, size: tuple[int, int], channels: int
) -> npt.NDArray[Any]:
    """The atlas as (count, height, width, channels)."""
    width, height = size
    grid = flat.reshape(whole[1] // height, height, columns, width, channels)
    return np.ascontiguousarray(grid.swapaxes(1, 2)).reshape(-1, height, width, channels)[:count]


def _homogeneous(transform: FloatArray) -> FloatArray:
    return np.vstack([transform, [0, 0, 0, 1]])


def _set(program: Any, name: str, value: object) -> None:
    if name in program:
        program[name].value = value


def _write(program: Any, name: str, matrix: FloatArray) -> None:
    if name in program:
        program[name].write(np.ascontiguousarray(matrix.T, np.float32).tobytes())
