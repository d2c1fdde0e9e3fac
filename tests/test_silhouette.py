"""The silhouette term: distance maps, skin colour, what pulls at the rim and what does not."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from fitting import camera, settings, silhouette, solver
from fitting.energy import Problem
from fitting.head_model import REGIONS
from fitting.pictures import Pictures
from fitting.rig import posed
from fitting.silhouette import Edge, Rim
from tests.landmarked import LENS, SIZE, landmarked_head, model_of, picture, random_state

D, SCALE_PX = 16, 75.0
HAIR, SKIN, WALL = (35, 25, 22), (165, 120, 100), (40, 70, 160)


@pytest.fixture(scope="module")
def made():
    """Rig, a frontal state of one frame, its picture and matte, and the skin's colour."""
    rig, model = model_of(landmarked_head())
    truth = random_state(model, 1, amount=0.0)
    truth = replace(truth, translation=np.array([[0.0, 0.01, 0.6]]))
    frame, alpha = picture(rig, truth, 0, background=WALL)
    pixels = np.argwhere(alpha[70:170, 100:160] > 250)[:, ::-1] + [100.5, 70.5]
    return rig, truth, frame, alpha, silhouette.skin_of([frame], [pixels])


def rim_of(made, pose=None, frame=None, alpha=None, truth=None):
    rig, state, image, matte, skin = made
    state = truth or state
    edge = silhouette.edge_of(matte if alpha is None else alpha)
    pose, image = pose or state.pose(0), image if frame is None else frame
    return silhouette.rim_of(rig, rig.vertices().folded(state.shape), pose, LENS, SIZE, image, edge, skin, SCALE_PX), edge


def term_of(made, pose, frame=None, alpha=None):
    rim, edge = rim_of(made, pose, frame, alpha)
    return silhouette.term_of(rim, edge, made[1].shape, 0.01 * SCALE_PX, 1.0, LENS, 3.0)


def gradient(made, pose, **pictures):
    """Pull [d] on a pose: against the gradient."""
    problem = Problem((term_of(made, pose, **pictures),), lambda _: (0.0, np.zeros(D), np.zeros((D, D))), np.ones(D, bool))
    return -problem.gradient(pose, problem.evaluate(pose)[1])


def moved(pose, translation=(0, 0, 0)):
    return replace(pose, translation=pose.translation + translation)


def grown(alpha, pixels):
    """The matte made wider (or narrower) by some pixels."""
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * abs(pixels) + 1,) * 2)
    return cv2.dilate(alpha, kernel) if pixels > 0 else cv2.erode(alpha, kernel)


def painted(frame, alpha, wide, colour):
    """A strip of that colour between the head and a wider matte."""
    strip = (wide > 127) & (alpha < 250)
    return np.where(strip[..., None], np.uint8(colour), frame)


def test_signed_distance_of_a_disc():
    y, x = np.mgrid[: SIZE[0], : SIZE[1]] + 0.5
    radius = np.hypot(x - 120, y - 110)
    edge = silhouette.edge_of(np.where(radius < 60, 255, 0).astype(np.uint8))
    assert edge.shrink == pytest.approx(1.0) and edge.distance.shape == (*SIZE, 3)
    near = (np.abs(radius - 60) < 25) & (np.abs(radius - 60) > 2)
    np.testing.assert_allclose(edge.distance[..., 0][near], (radius - 60)[near], atol=1.0)
    outward = np.stack([x - 120, y - 110], -1) / radius[..., None]
    assert (np.einsum("nk,nk->n", edge.distance[..., 1:][near], outward[near]) > 0.9).all()
    assert edge.border[0].all() and edge.border[:, -1].all() and not edge.border[10:-10, 10:-10].any()


def test_a_larger_matte_is_measured_in_the_buffers_pixels():
    y, x = np.mgrid[:480, :512] + 0.5
    edge = silhouette.edge_of(np.where(x < 200, 255, 0).astype(np.uint8))
    assert edge.shrink == 0.5 and edge.distance.shape[:2] == (240, 256)
    assert edge.distance[100, 139, 0] == pytest.approx(39.5, abs=1)


def test_skin_is_learned_from_the_face(made):
    skin = made[4]
    assert skin.likeness(np.array(SKIN)) > 0.95
    assert skin.likeness(np.array(SKIN) * 0.75) > 0.8  # in the shade
    for colour in (HAIR, WALL, (240, 240, 240), (30, 120, 40)):
        assert skin.likeness(np.array(colour)) < 0.05, colour
    grid = skin.likeness(np.full((2, 3, 3), SKIN))
    assert grid.shape == (2, 3)
    with pytest.raises(ValueError, match="only 49 pixels of skin"):
        silhouette.skin_of([made[2]], [np.concatenate([np.full((49, 2), 100.0), [[-5.0, 3.0], [999.0, 3.0]]])])


def test_a_few_dark_pixels_are_not_skin(made):
    frame = made[2].copy()
    frame[90:100, 110:150] = HAIR  # brows
    pixels = np.argwhere(made[3][70:170, 100:160] > 250)[:, ::-1] + [100.5, 70.5]
    assert silhouette.skin_of([frame], [pixels]).likeness(np.array(HAIR)) < 0.3


def plane(slope=(0.8, -0.6), start=0.0) -> Edge:
    """A straight edge: the distance is exact everywhere."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]].astype(np.float64)
    value = start + slope[0] * (x - 128) + slope[1] * (y - 120)
    return Edge(np.stack([value, 0 * x + slope[0], 0 * x + slope[1]], -1).astype(np.float32), 1.0, np.zeros(SIZE, bool))


@pytest.mark.parametrize("start", [30.0, -30.0])
def test_gradient_against_differences(made, start):
    """Outside (Huber, margin) and inside (Geman-McClure) of a straight edge; wide steps: OpenCV reads in 1/32 pixel."""
    rig, truth, *_ = made
    random = np.random.default_rng(0)
    triangles, barycentric = random.integers(0, len(rig.triangles), 60), random.dirichlet([1, 1, 1], 60)
    rim = Rim(triangles, barycentric, random.uniform(0, 1, 60), random.uniform(0, 3, 60), rig.surface(triangles, barycentric))
    term = silhouette.term_of(rim, plane(start=start * 3), truth.shape, 8.0, 0.7, LENS, 3.0)
    problem = Problem((term,), lambda _: (0.0, np.zeros(D), np.zeros((D, D))), np.ones(D, bool))
    pose = truth.pose(0)
    ours = problem.gradient(pose, problem.evaluate(pose)[1])
    for unknown, step in zip(range(6), [0.01, 0.01, 0.01, 0.002, 0.002, 0.01], strict=True):
        away = step * np.eye(D)[unknown]
        ahead, behind = (problem.evaluate(pose.moved(sign * away))[0] for sign in (1, -1))
        assert ours[unknown] == pytest.approx((ahead - behind) / (2 * step), rel=0.02, abs=0.02 * np.abs(ours[:6]).max())


def test_the_rim_is_the_outline(made):
    rig, truth, _, alpha, _ = made
    rim, edge = rim_of(made)
    assert 100 < len(rim.triangles) <= silhouette.RIM_POINTS
    points = posed(rim.surface.folded(truth.shape), truth.pose(0)).points
    pixel = camera.project(points, LENS.focal_px, LENS.centre_px)
    distance = edge.distance[pixel[:, 1].astype(int), pixel[:, 0].astype(int), 0]
    assert np.abs(distance).max() < 2.0  # the matte is the mesh's own
    angle = np.sort(np.arctan2(*(pixel - pixel.mean(0)).T))
    assert np.diff(angle[5:-5]).max() < 0.8  # all around, but for the neck's end
    np.testing.assert_allclose(rim.barycentric.sum(1), 1, atol=1e-5)


def test_the_cut_of_the_neck_is_no_rim(made):
    rig = made[0]
    rim, _ = rim_of(made)
    lowest = rig.template[:, 1].max()
    assert rig.template[rig.triangles[rim.triangles], 1].max() <= lowest - 0.012
    assert (rim.surface.base[:, 1] > 0.06).any()  # but the chin is


def test_the_border_of_the_picture_is_no_edge(made):
    """A head that leaves the picture: no rim along the border, where the matte ends because the picture does."""
    rig, truth, _, _, _ = made
    near = replace(truth, translation=np.array([[0.12, 0.01, 0.5]]))
    frame, alpha = picture(rig, near, 0, background=WALL)
    assert alpha[:, -1].max() == 255
    rim, _ = rim_of(made, near.pose(0), frame, alpha)
    pixel = camera.project(posed(rim.surface.folded(near.shape), near.pose(0)).points, LENS.focal_px, LENS.centre_px)
    assert pixel[:, 0].max() < SIZE[1] - 2
    assert np.abs(gradient(made, near.pose(0), frame=frame, alpha=alpha)[3:6]).max() < np.abs(
        gradient(made, moved(near.pose(0), (0.01, 0, 0)), frame=frame, alpha=alpha)[3]
    )


def test_a_head_out_of_the_picture_has_no_rim(made):
    assert rim_of(made, moved(made[1].pose(0), (0.6, 0, 0)))[0] is None


@pytest.mark.parametrize("colour", [SKIN, HAIR])
def test_mesh_outside_is_pulled_in_whatever_is_there(made, colour):
    """A matte narrower than the mesh: the head moves away from the camera."""
    frame = np.full((*SIZE, 3), colour, np.uint8)
    assert gradient(made, made[1].pose(0), frame=frame, alpha=grown(made[3], -5))[5] > 100


def test_mesh_inside_is_pulled_out_where_it_looks_like_skin(made):
    """A matte 6 px wider than the mesh: cheeks pull at it, hair does not."""
    _, truth, frame, alpha, _ = made
    wide, pose = grown(alpha, 6), truth.pose(0)
    skin, hair = (painted(frame, alpha, wide, colour) for colour in (SKIN, HAIR))
    like, unlike = (rim_of(made, pose, image, wide)[0] for image in (skin, hair))
    assert np.median(like.attraction) > 0.8 and unlike.attraction.max() < 0.1
    outwards, still = (gradient(made, pose, frame=image, alpha=wide)[5] for image in (skin, hair))
    assert outwards < -20 and abs(still) < 0.02 * abs(outwards)


def test_a_far_edge_lets_go(made):
    """Shoulders or thick hair: an edge far from the rim says nothing, even if it looks like skin."""
    _, truth, frame, alpha, _ = made
    wide = grown(alpha, 40)
    rim, _ = rim_of(made, None, painted(frame, alpha, wide, SKIN), wide)
    assert not rim.attraction[rim.surface.base[:, 1] < 0.05].any()


def test_the_neck_is_not_pulled_out(made):
    rig, truth, frame, alpha, _ = made
    wide = grown(alpha, 6)
    rim, _ = rim_of(made, None, painted(frame, alpha, wide, SKIN), wide)
    neck = rig.region[rig.triangles[rim.triangles][:, 0]] == REGIONS.index("neck")
    assert not rim.attraction[neck].any() and rim.attraction[~neck].any()


def test_hair_keeps_the_scalp_inside(made):
    """Under hair a margin of some millimetres; on a bald skull none."""
    rig, _, frame, alpha, _ = made
    scalp = lambda rim: rig.region[rig.triangles[rim.triangles][:, 0]] == REGIONS.index("scalp")  # noqa: E731
    bald, _ = rim_of(made)
    haired, _ = rim_of(made, None, np.where(alpha[..., None] > 100, np.uint8(HAIR), frame))
    expected = silhouette.HAIR_M * LENS.focal_px / 0.6
    assert np.median(haired.margin_px[scalp(haired)]) == pytest.approx(expected, rel=0.1)
    assert np.median(bald.margin_px[scalp(bald)]) < 0.2 * expected
    assert not haired.margin_px[~scalp(haired)].any() and scalp(haired).sum() > 20


@pytest.mark.parametrize("shift", [(0.006, 0, 0), (-0.004, 0, 0), (0, 0, -0.02), (0, 0, 0.03)])
def test_a_shifted_head_is_moved_back(made, shift):
    _, truth, *_ = made
    pose = moved(truth.pose(0), shift)
    for _ in range(3):  # the rim is found anew
        problem = Problem(
            (term_of(made, pose),), lambda _: (0.0, np.zeros(D), np.zeros((D, D))), np.isin(np.arange(D), [3, 4, 5])
        )
        pose = solver.solve_frame(problem, pose, 10)[0]
    away = pose.translation - truth.translation[0]
    assert np.abs(away[:2]).max() * LENS.focal_px / 0.6 < 0.7
    assert abs(away[2]) < 0.01


def test_pictures_make_the_same_term(made):
    """`Pictures.silhouette_terms` and `silhouette_extra` build what the functions here do."""
    rig, truth, frame, alpha, skin = made
    pictures = Pictures(rig, frame[None], alpha[None], np.array([SCALE_PX]), settings.STRENGTH, 400)
    pictures.learn_skin([0], truth, LENS)
    assert pictures.skin.likeness(np.array(SKIN)) > 0.9
    pictures.skin = skin
    pose = moved(truth.pose(0), (0.004, 0, 0))
    (term,) = pictures.silhouette_terms(0, pictures.look(0, pose, truth.shape, LENS), truth.shape, LENS)
    rim, edge = rim_of(made, pose)
    strength = settings.STRENGTH
    ours = silhouette.term_of(
        rim, edge, truth.shape, strength.silhouette_sigma * SCALE_PX, strength.silhouette, LENS, strength.silhouette_robust
    )
    at = posed(term.surface, pose)
    assert term.rows(at).cost == pytest.approx(ours.rows(posed(ours.surface, pose)).cost)
    state = truth.with_poses([pose])
    ((other, surface),) = pictures.silhouette_extra([0], state, LENS.centre_px)(state, 0)
    assert other.rows(posed(other.surface, pose)).cost == pytest.approx(term.rows(at).cost, rel=1e-9)
    np.testing.assert_array_equal(surface.base, rim.surface.base)
    outside = pictures.look(0, moved(pose, (0.6, 0, 0)), truth.shape, LENS)
    assert pictures.silhouette_terms(0, outside, truth.shape, LENS) == []
