"""Pictures agree with the poses they are said to have."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from relpose_ros.captures import renderer as drawing
from relpose_ros.captures import scenes, shapes
from relpose_ros.captures.objects import Part, SyntheticObject
from relpose_ros.captures.renderer import Renderer, Window
from relpose_ros.captures.scenes import Motion, ScanStyle, Scene, Shot, Surroundings
from relpose_ros.geometry.cameras import look_at
from relpose_ros.views import Intrinsics

SIZE = 96
WHITE = np.full((2, 2, 3), 200, np.uint8)
GREY_ROOM = np.full((16, 32, 3), 90, np.uint8)


def random_scene(seed: int) -> Scene:
    return scenes.random_scene(np.random.default_rng(seed), 3, ScanStyle())


def windows(scene: Scene) -> list[Window]:
    found = []
    for shot in scene.shots:
        side = 1.2 * max(shot.box.width, shot.box.height)
        x, y = (shot.box.x0 + shot.box.x1 - side) / 2, (shot.box.y0 + shot.box.y1 - side) / 2
        found.append(Window(round(x), round(y), round(side), round(side)))
    return found


def single(
    thing: SyntheticObject, surroundings: Surroundings, direction: tuple[float, float, float]
) -> Scene:
    centre = 4 * np.asarray(direction) / np.linalg.norm(direction)
    rotation = look_at(centre, np.zeros(3))
    pose = np.column_stack([rotation, -rotation @ centre])
    intrinsics = Intrinsics(100, 100, 48, 48)
    points = np.concatenate([part.mesh.positions for part in thing.parts])
    box, complete = scenes.bounding_box(points, pose, intrinsics, SIZE, SIZE)
    shot = Shot(pose, np.eye(3), intrinsics, SIZE, SIZE, box, complete)
    return Scene(thing, surroundings, (shot,), Motion.CAMERA)


def room(**changes: object) -> Surroundings:
    plain = Surroundings(panorama=GREY_ROOM, room_half=np.full(3, 10.0), eye=np.zeros(3), shadow=0.0)
    return replace(plain, **changes)  # type: ignore[arg-type]


WHOLE = [Window(0, 0, SIZE, SIZE)]


@pytest.mark.parametrize("seed", range(6))
def test_each_pixel_shows_the_point_that_the_pose_puts_there(renderer: Renderer, seed: int) -> None:
    scene = random_scene(seed)
    drawn, places = renderer.draw_with_places(scene, windows(scene), (SIZE, SIZE), 8, supersampling=1)
    for shot, window, map_of, picture in zip(scene.shots, windows(scene), places, drawn, strict=True):
        seen = ~np.isnan(map_of[..., 0])
        assert (seen == (picture[4::8, 4::8, 3] > 0)).mean() > 0.97
        points = map_of[seen].astype(np.float64)
        assert (np.linalg.norm(points, axis=1) < 1.01).all()
        local = points @ shot.camera_from_object[:, :3].T + shot.camera_from_object[:, 3]
        k = shot.intrinsics
        u = (k.fx * local[:, 0] / local[:, 2] + k.cx - window.x0) / window.width * SIZE
        v = (k.fy * local[:, 1] / local[:, 2] + k.cy - window.y0) / window.height * SIZE
        rows, columns = np.nonzero(seen)
        # Half-precision coordinates: well within a tenth of a pixel.
        assert np.abs(u - (columns * 8 + 4)).max(initial=0) < 0.1
        assert np.abs(v - (rows * 8 + 4)).max(initial=0) < 0.1


@pytest.mark.parametrize("seed", range(4))
def test_the_box_is_where_the_object_is_seen(renderer: Renderer, seed: int) -> None:
    thing = scenes.random_scene(np.random.default_rng(seed), 1, ScanStyle()).thing
    scene = single(thing, room(), (1.0, 0.5, 0.7))
    covered = renderer.draw(scene, WHOLE, (4 * SIZE, 4 * SIZE), supersampling=1)[0, ..., 3] > 0
    rows, columns = np.nonzero(covered)
    box = scene.shots[0].box
    # Quarter pixels; a corner thinner than that may fall between them.
    found = np.array([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]) / 4
    assert np.abs(found - (box.x0, box.y0, box.x1, box.y1)).max() < 1.0


def test_a_view_does_not_depend_on_the_others_drawn_with_it(renderer: Renderer) -> None:
    scene = random_scene(5)
    together = renderer.draw(scene, windows(scene), (SIZE, SIZE))
    for k, (shot, window) in enumerate(zip(scene.shots, windows(scene), strict=True)):
        alone = renderer.draw(replace(scene, shots=(shot,)), [window], (SIZE, SIZE))
        # Places in the atlas differ in the last bit of a coordinate, which an edge here and there shows.
        assert (alone[0] == together[k]).mean() > 0.999


def test_beyond_the_image_it_is_black(renderer: Renderer) -> None:
    scene = single(SyntheticObject((Part(shapes.box(), WHITE),)), room(), (1, 1, 1))
    picture = renderer.draw(scene, [Window(-48, 0, 96, 96)], (SIZE, SIZE), supersampling=1)[0]
    assert (picture[:, :48] == 0).all()
    assert (picture[:, 48:, :3] > 0).all()


def test_a_window_is_a_part_of_the_picture(renderer: Renderer) -> None:
    scene = random_scene(2)
    scene = replace(scene, shots=scene.shots[:1])
    shot = scene.shots[0]
    whole = renderer.draw(
        scene, [Window(0, 0, shot.width, shot.height)], (shot.width, shot.height), supersampling=1
    )[0]
    part = renderer.draw(scene, [Window(64, 32, 128, 128)], (128, 128), supersampling=1)[0]
    off = np.abs(whole[32:160, 64:192].astype(int) - part).max(-1)
    # Quads over which the driver takes texture derivatives may begin elsewhere.
    assert (off <= 3).mean() > 0.99


def test_light_from_all_around_lights_every_side_alike() -> None:
    coefficients = drawing._ambient(GREY_ROOM)
    assert np.allclose(coefficients[0], (90 / 255) ** 2, rtol=0.01)
    assert np.abs(coefficients[1:]).max() < 0.01 * coefficients[0].max()
    assert (drawing._octahedral(GREY_ROOM) == 90).all()


def test_light_from_above_lights_what_faces_up() -> None:
    sky = GREY_ROOM.copy()
    sky[:8], sky[8:] = 255, 0
    first, _, up, *_ = drawing._ambient(sky)[:, 0]
    # A hemisphere of unit radiance: 1 facing it, 1/2 sideways, 0 away.
    assert first + up == pytest.approx(1, abs=0.02)
    assert first - up == pytest.approx(0, abs=0.02)


def test_the_light_comes_from_where_it_is_said(renderer: Renderer) -> None:
    ball = SyntheticObject((Part(shapes.superquadric(rings=40, sectors=60), WHITE),))
    lit = single(ball, room(to_light=np.array([0.0, 1.0, 0.0]), ambient=0.1), (1, 0, 0))
    picture = renderer.draw(lit, WHOLE, (SIZE, SIZE))[0].astype(int)
    # Seen from +x with z up, +y is on the right.
    assert picture[48, 60, 0] > 2 * picture[48, 36, 0]


def test_things_throw_shadows_on_the_ground(renderer: Renderer) -> None:
    slab = Part(shapes.box((8, 8, 0.1)).moved((0, 0, -0.56)), WHITE)
    cube = SyntheticObject((Part(shapes.box((1, 1, 1)), WHITE),))
    slanted = np.array([0.0, 0.6, 0.8])
    bright, dark = (
        renderer.draw(
            single(cube, room(ground=slab, ground_z=-0.51, to_light=slanted, shadow=shadow), (1, 0, 1)),
            WHOLE,
            (SIZE, SIZE),
        )
        for shadow in (0.0, 1.0)
    )
    darker = (bright.astype(int) - dark)[0, ..., 0] > 20
    ground = bright[0, ..., 3] == 0
    rows, columns = np.nonzero(darker & ground)
    assert len(rows) > 50
    assert columns.mean() < 48, "the light is on the right, so the shadow lies on the left"
