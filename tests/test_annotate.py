"""Annotation: distances from surfaces, trajectories from keyframes, contacts found again, and a person's last word."""

from __future__ import annotations

import resource
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hdmi.assembly import scene_parts
from hdmi.assets import Effector, GeomConfig, HingeConfig, ObjectConfig
from hdmi.assets.solid import Solid
from hdmi.commands import annotate
from hdmi.config import task_config
from hdmi.motion import Motion, MotionError, find_motion, load_motion, save_motion
from hdmi.workshop.annotate import (
    ContactCriteria,
    Interval,
    Overrides,
    Surface,
    agreement,
    annotate_motion,
    complete_hinge,
    complete_object,
    complete_trajectory,
    intervals,
    load_overrides,
    object_surfaces,
)
from hdmi.workshop.annotate.contacts import _label

QUARTER = (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))  # about z
LEFT, RIGHT = "left_wrist_yaw_link", "right_wrist_yaw_link"


@pytest.fixture(scope="module")
def lift_box() -> tuple[Motion, dict]:
    """The shipped reference and its scene, with a higher box.

    The nearest surface to fingertips that press is then the side that they press, not the top.
    """
    box = ObjectConfig("box", [{"box": (0.12, 0.14, 0.14)}], mass=0.5)
    return load_motion(find_motion("lift_box")), scene_parts(task_config("lift_box")) | {"object": box}


class TestSurface:
    @pytest.mark.parametrize(
        ("geom", "point", "distance"),
        [
            ({"box": (0.1, 0.2, 0.3)}, (0.4, 0.0, 0.0), 0.3),
            ({"box": (0.1, 0.2, 0.3)}, (0.4, 0.6, 0.0), 0.5),  # from an edge: 3-4-5
            ({"box": (0.1, 0.2, 0.3)}, (0.07, 0.0, 0.0), -0.03),
            ({"box": (0.1, 0.2, 0.3), "pos": (1.0, 0, 0), "quat": QUARTER}, (1.0, 0.4, 0.0), 0.3),
            ({"box": (0.1, 0.2, 0.3), "pos": (1.0, 0, 0), "body_quat": QUARTER}, (0.0, 1.4, 0.0), 0.3),
            ({"sphere": 0.32}, (0.0, 0.0, 0.5), 0.18),
            ({"capsule": (0.1, 0.5)}, (0.3, 0.0, 0.2), 0.2),
            ({"capsule": (0.1, 0.5)}, (0.0, 0.0, 0.7), 0.1),
            ({"cylinder": (0.1, 0.5)}, (0.4, 0.0, 0.9), 0.5),
            ({"cylinder": (0.1, 0.5)}, (0.0, 0.0, 0.45), -0.05),
        ],
    )
    def test_primitives(self, geom, point, distance):
        assert Surface([GeomConfig(**geom)]).distance(np.array(point)) == pytest.approx(distance)

    def test_meshes_are_not_their_hulls(self, tmp_path):
        pytest.importorskip("igl")
        ring = trimesh.creation.annulus(r_min=0.2, r_max=0.3, height=0.1)
        ring.export(tmp_path / "ring.stl")
        surface = Surface([GeomConfig(mesh=str(tmp_path / "ring.stl"))])
        points = np.array([[0.0, 0.0, 0.0], [0.25, 0.0, 0.0], [0.5, 0.0, 0.0]])  # hole, material, outside
        np.testing.assert_allclose(surface.distance(points), [0.2, -0.05, 0.2], atol=5e-3)

    @given(
        point=st.tuples(*[st.floats(-0.6, 0.6)] * 3),
        geom=st.sampled_from(
            [{"box": (0.1, 0.2, 0.3)}, {"sphere": 0.25}, {"capsule": (0.1, 0.2)}, {"cylinder": (0.2, 0.3)}]
        ),
    )
    def test_nearest_point_is_on_the_surface(self, point, geom):
        surface = Surface([GeomConfig(**geom)])
        points = np.array([point])
        distance = surface.distance(points)
        if distance[0] < 1e-3:
            return  # inside, the gradient jumps between faces
        nearest = surface.nearest(points)
        np.testing.assert_allclose(surface.distance(nearest), 0, atol=1e-4)
        np.testing.assert_allclose(np.linalg.norm(nearest - points), distance[0], atol=1e-4)

    def test_bodies_of_an_articulated_object(self):
        door = ObjectConfig(
            "door", [{"sphere": 0.1}], hinge=HingeConfig("door_joint", "panel", [{"box": (0.02, 0.5, 1.0)}])
        )
        assert list(object_surfaces(door)) == ["door", "panel"]


def crate(change: str) -> trimesh.Trimesh:
    """A box of half extents 0.12, 0.14 and 0.10 m, whose triangles are ordered in some way or other."""
    box = trimesh.creation.box((0.24, 0.28, 0.20)).subdivide()
    faces, turned = np.array(box.faces), box.faces[:, ::-1]
    some = np.random.default_rng(0).random(len(faces)) < 0.4
    if change == "inverted":
        faces = turned
    elif change == "mixed":
        faces[some] = turned[some]
    elif change == "doubled":
        faces = np.concatenate([faces, turned])
    elif change == "bottomless, inverted":
        faces = turned[box.triangles_center[:, 2] > -0.099]
    elif change == "bottomless":
        faces = faces[box.triangles_center[:, 2] > -0.099]
    out = trimesh.Trimesh(box.vertices, faces, process=False)
    if change == "no shared corners":  # as texture seams leave it
        faces[some] = turned[some]
        corners = box.vertices[faces].reshape(-1, 3)
        out = trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), process=False)
    elif change == "loose sides, inverted":
        corners = box.vertices[faces[:, ::-1]] + 1e-4 * box.face_normals[:, None]
        out = trimesh.Trimesh(corners.reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3), process=False)
    return out


class TestSolid:
    @pytest.fixture(autouse=True)
    def _igl(self):
        pytest.importorskip("igl")

    @pytest.mark.parametrize(
        "change",
        [
            "none",
            "inverted",
            "mixed",
            "doubled",
            "no shared corners",
            "loose sides, inverted",
            "bottomless",
            "bottomless, inverted",
        ],
    )
    def test_order_of_triangles_does_not_matter(self, change):
        points = np.random.default_rng(1).uniform(-0.25, 0.25, (500, 3))
        expected = Surface([GeomConfig(box=(0.12, 0.14, 0.10))]).distance(points)
        if "bottomless" in change:  # nothing is near where the bottom was
            points, expected = points[points[:, 2] > 0.0], expected[points[:, 2] > 0.0]
        distance, nearest = Solid(crate(change)).nearest(points)
        np.testing.assert_allclose(distance, expected, atol=2e-4)
        np.testing.assert_allclose(np.linalg.norm(points - nearest, axis=-1), np.abs(expected), atol=2e-4)

    def test_each_shell_is_solid_whichever_way_it_faces(self):
        left, right = trimesh.creation.icosphere(radius=0.1), trimesh.creation.icosphere(radius=0.1)
        right.apply_translation([0.15, 0.0, 0.0])  # they overlap
        right.invert()
        solid = Solid(trimesh.util.concatenate([left, right]))
        distance, _ = solid.nearest(np.array([[0.0, 0, 0], [0.075, 0, 0], [0.15, 0, 0], [0.35, 0, 0], [-0.2, 0, 0]]))
        assert (distance < 0).tolist() == [True, True, True, False, False]

    def test_memory_does_not_grow_with_points_times_faces(self):
        ball = trimesh.creation.icosphere(subdivisions=6, radius=0.1)  # 81,920 faces
        points = np.random.default_rng(0).normal(size=(20_000, 3))
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        distance, _ = Solid(ball).nearest(points)
        grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 2**20  # GiB on Linux
        np.testing.assert_allclose(distance, np.linalg.norm(points, axis=-1) - 0.1, atol=1e-4)
        assert grown < 1.0  # a byte for each pair would be 1.5

    def test_labels_of_a_mesh_are_those_of_its_box(self, tmp_path):
        parts = scene_parts(task_config("lift_box"))
        motion, found = load_motion(find_motion("lift_box")), []
        crate("inverted").export(tmp_path / "crate.obj")
        for geom in ({"box": (0.12, 0.14, 0.10)}, {"mesh": str(tmp_path / "crate.obj")}):
            found.append(annotate_motion(motion, **parts | {"object": replace(parts["object"], geoms=[geom])}))
        np.testing.assert_array_equal(found[0].object_contact, found[1].object_contact)
        np.testing.assert_allclose(found[0].contact_points, found[1].contact_points, atol=1e-5)


def hands(seed: int, num_frames: int = 40, count: int = 2) -> tuple[np.ndarray, np.ndarray, Rotation, np.ndarray]:
    """Hands fixed to a body that moves smoothly: their positions and quaternions, and the body's pose."""
    rng = np.random.default_rng(seed)
    u = np.linspace(0, 1, num_frames)
    pos = u[:, None] * rng.normal(size=3) + np.sin(3 * u)[:, None] * rng.normal(size=3)
    body = Rotation.from_rotvec(u[:, None] * rng.normal(size=3)) * Rotation.random(rng=seed)
    offset, turn = rng.normal(size=(count, 3)), Rotation.random(count, rng=seed)
    hand_pos = np.stack([pos + body.apply(o) for o in offset], axis=1)
    hand_quat = np.stack([(body * r).as_quat(scalar_first=True) for r in turn], axis=1)
    return hand_pos, hand_quat, body, pos


class TestTrajectory:
    @given(seed=st.integers(0, 1000), count=st.integers(1, 3), frame=st.integers(0, 39))
    def test_held_objects_follow_the_hands(self, seed, count, frame):
        hand_pos, hand_quat, body, truth = hands(seed, count=count)
        key = {frame: (truth[frame], body[frame].as_quat(scalar_first=True))}
        pos, quat = complete_trajectory(key, hand_pos, hand_quat, np.ones((40, count), bool))
        np.testing.assert_allclose(pos, truth, atol=1e-6)
        assert (Rotation.from_quat(quat, scalar_first=True) * body.inv()).magnitude().max() < 1e-6

    def test_objects_rest_where_they_are_left(self):
        hand_pos, hand_quat, body, truth = hands(3, count=1)
        contact = np.zeros((40, 1), bool)
        contact[10:26] = True
        start = (truth[10], body[10].as_quat(scalar_first=True))
        pos, quat = complete_trajectory({0: start}, hand_pos, hand_quat, contact)
        np.testing.assert_allclose(pos[:11], np.tile(truth[10], (11, 1)))
        np.testing.assert_allclose(pos[10:26], truth[10:26], atol=1e-6)
        np.testing.assert_allclose(pos[25:], np.tile(truth[25], (15, 1)), atol=1e-6)
        assert (np.abs(np.diff(quat[25:], axis=0)) < 1e-9).all()

    def test_keyframes_are_met_and_the_difference_is_spread_over_the_contact(self):
        hand_pos = np.zeros((40, 1, 3))
        hand_pos[:, 0, 0] = np.clip(np.arange(40) - 10, 0, 20) * 0.05  # one metre from frame 10 to 30
        hand_quat = np.tile([1.0, 0, 0, 0], (40, 1, 1))
        contact = np.zeros((40, 1), bool)
        contact[10:31] = True
        upright = [1.0, 0, 0, 0]
        keys = {0: ([0.0, 0, 0], upright), 39: ([1.1, 0, 0], QUARTER)}  # 10 cm further and a quarter turn
        pos, quat = complete_trajectory(keys, hand_pos, hand_quat, contact)
        np.testing.assert_allclose(pos[:11], 0, atol=1e-9)
        np.testing.assert_allclose(pos[30:], np.tile([1.1, 0, 0], (10, 1)), atol=1e-9)
        assert pos[20, 0] == pytest.approx(0.5 + 0.05)  # halfway, half of the difference
        angle = Rotation.from_quat(quat[20], scalar_first=True).magnitude()
        assert angle == pytest.approx(np.pi / 4)
        assert (np.diff(pos[:, 0]) >= -1e-12).all()

    def test_objects_that_move_by_themselves_are_interpolated(self):
        keys = {0: ([0.0, 0, 0], [1, 0, 0, 0]), 20: ([0.0, 0, 1.0], [1, 0, 0, 0])}
        pos, _ = complete_trajectory(
            keys, np.zeros((30, 1, 3)), np.tile([1.0, 0, 0, 0], (30, 1, 1)), np.zeros((30, 1), bool)
        )
        assert pos[10, 2] == pytest.approx(0.5)
        np.testing.assert_allclose(pos[20:, 2], 1.0)

    def test_hinge(self):
        angle = np.linspace(0.1, 0.9, 30)
        hand = np.stack([np.cos(angle), np.sin(angle), 0.7 + 0 * angle], axis=-1)[:, None]
        contact = np.zeros((40, 1), bool)
        contact[5:30] = True
        hand = np.concatenate([hand, np.repeat(hand[-1:], 10, axis=0)])
        out = complete_hinge({0: 0.0}, hand, contact, axis=[0, 0, 1])
        np.testing.assert_allclose(out[:6], 0)
        np.testing.assert_allclose(out[29:], angle[29] - angle[5], atol=1e-9)
        both = complete_hinge({0: 0.0, 39: 1.0}, hand, contact, axis=[0, 0, 1])
        assert both[39] == 1.0
        np.testing.assert_allclose(both[29:], 1.0, atol=1e-9)

    @pytest.mark.parametrize("keyframes", [{}, {40: ([0, 0, 0], [1, 0, 0, 0])}])
    def test_keyframes_outside_of_the_motion(self, keyframes):
        with pytest.raises(MotionError, match="object trajectory"):
            complete_trajectory(keyframes, np.zeros((40, 1, 3)), np.ones((40, 1, 4)), np.zeros((40, 1), bool))


class TestOverrides:
    def write(self, tmp_path: Path, text: str) -> Path:
        path = tmp_path / "annotation.yaml"
        path.write_text(text, encoding="utf-8")
        return path

    def test_every_part(self, tmp_path):
        overrides = load_overrides(
            self.write(
                tmp_path,
                """
                object:
                  - {frame: 0, pos: [1, 2, 3], quat: [0, 1, 0, 0]}
                  - {frame: 9, pos: [4, 5, 6]}
                hinge: [{frame: 3, angle: 0.5}]
                contacts:
                  left: [{frames: [1, 4]}, {frames: [6, 8], point: [0, 1, 2]}]
                  right: []
                points: {left: [7, 8, 9]}
                """,
            )
        )
        assert overrides == Overrides(
            object={0: ((1, 2, 3), (0, 1, 0, 0)), 9: ((4, 5, 6), (0, 1, 0, 0))},
            hinge={3: 0.5},
            contacts={"left": (Interval(1, 4), Interval(6, 8, (0, 1, 2))), "right": ()},
            points={"left": (7, 8, 9)},
        )

    def test_an_empty_file_says_nothing(self, tmp_path):
        assert load_overrides(self.write(tmp_path, "")) == Overrides()

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("contact: {}", "contacts"),
            ("[1, 2]", "mapping"),
            ("object: {frame: 0}", "object: a list"),
            ("object: [{frame: 0}]", r"object\[0\]"),
            ("object: [{frame: 0, pos: [1, 2]}]", r"object\[0\].pos: 3 numbers"),
            ("object: [{frame: 0, pos: [1, 2, .nan]}]", r"object\[0\].pos"),
            ("object: [{frame: 0, pos: [1, 2, 3], quat: [1, 1, 0, 0]}]", "unit quaternion"),
            ("object: [{frame: -1, pos: [1, 2, 3]}]", "frame number"),
            ("hinge: [{frame: 0, angle: much}]", r"hinge\[0\].angle"),
            ("contacts: {left: [{frames: [5, 3]}]}", "comes before"),
            ("contacts: {left: [{frames: 5}]}", "first and last"),
            ("contacts: {left: 5}", "contacts.left"),
            ("points: {left: here}", "points.left"),
            ("object: [", "cannot be read"),
            ("object: ${secret}", "object: a list"),
        ],
    )
    def test_mistakes_are_named(self, tmp_path, text, message):
        with pytest.raises(MotionError, match=message):
            load_overrides(self.write(tmp_path, text))

    def test_no_such_file(self, tmp_path):
        with pytest.raises(MotionError, match="cannot be read"):
            load_overrides(tmp_path / "annotation.yaml")


class TestCriteria:
    """Labels from gaps, speeds of the object and speeds of the effector in its frame, made by hand at 50 fps."""

    T = 300

    def label(
        self, gap: np.ndarray | float, speed: np.ndarray | float = 0.1, relative: float = 0.09, fixed: bool = False
    ) -> list[tuple[int, int]]:
        gap, speed, relative = (np.broadcast_to(value, self.T).astype(float) for value in (gap, speed, relative))
        return intervals(_label(gap, speed, relative, fixed, 50.0, ContactCriteria()))

    def within(self, spans: dict[tuple[int, int], float], otherwise: float) -> np.ndarray:
        out = np.full(self.T, otherwise)
        for (first, last), value in spans.items():
            out[first : last + 1] = value
        return out

    def test_begins_nearer_than_it_ends(self):
        assert self.label(self.within({(60, 89): 0.035, (90, 129): 0.02, (130, 159): 0.035}, 0.06)) == [(90, 159)]
        assert self.label(self.within({(60, 159): 0.035}, 0.06)) == []

    def test_what_slides_past_is_no_contact(self):
        assert self.label(0.01, speed=0.1, relative=0.19) == [(0, 299)]
        assert self.label(0.01, speed=0.1, relative=0.21) == []
        assert self.label(0.01, speed=0.06, relative=0.099) == [(0, 299)]  # slow enough in itself

    def test_what_moves_along_is_held_from_further_away(self):
        assert self.label(0.08, speed=self.within({(100, 199): 0.2}, 0.0), relative=0.09) == [(100, 199)]
        assert self.label(0.08, speed=0.2, relative=0.11) == []
        assert self.label(0.11, speed=0.2, relative=0.0) == []

    def test_short_pauses_are_bridged_and_short_contacts_dropped(self):
        near = {(50, 99): 0.01, (115, 160): 0.01, (200, 210): 0.01}
        assert self.label(self.within(near, 0.06)) == [(50, 160)]
        assert self.label(self.within({(50, 99): 0.01, (120, 160): 0.01}, 0.06)) == [(50, 99), (120, 160)]

    def test_counts_around_the_objects_motion_only_unless_it_is_fixed(self):
        moving = self.within({(100, 119): 0.1}, 0.0)
        assert self.label(0.01, moving) == [(50, 169)]  # a second before and after
        assert self.label(0.01, 0.0) == []
        assert self.label(self.within({(20, 80): 0.01}, 0.06), 0.0, fixed=True) == [(20, 80)]


class TestContacts:
    def test_labels_are_found_again(self, lift_box):
        motion, scene = lift_box
        bare = replace(motion, object_contact=None, contact_points=None)
        found = annotate_motion(bare, **scene)
        compared = agreement(found.object_contact, motion.object_contact)
        assert compared.precision > 0.9
        assert compared.recall > 0.9
        # on the sides of the box; the fingertips are where the task's targets are
        middle = found.contact_points[150]
        np.testing.assert_allclose(np.abs(middle[:, 1]), 0.14, atol=1e-4)
        np.testing.assert_allclose(middle, [effector.target for effector in scene["effectors"]], atol=0.02)

    @pytest.mark.parametrize("name", ["move_suitcase", "push_box"])
    def test_labels_of_public_motions(self, public_motions, name):
        motion = load_motion(public_motions / name)
        found = annotate_motion(replace(motion, object_contact=None), **scene_parts(task_config(name)))
        compared = agreement(found.object_contact, motion.object_contact)
        assert compared.precision > 0.9
        assert compared.recall > 0.9

    def test_hands_near_an_object_that_nobody_moves(self, lift_box):
        motion, scene = lift_box
        box = motion.body_names.index("box")
        pos = motion.body_pos_w.copy()
        pos[:, box] = pos[0, box]
        found = annotate_motion(replace(motion, body_pos_w=pos), **scene)
        assert not found.object_contact.any()

    def test_objects_that_cannot_move_are_touched_where_hands_are_near(self, lift_box):
        motion, scene = lift_box
        still = {key: getattr(motion, key).copy() for key in ("body_pos_w", "joint_pos", "body_quat_w")}
        for value in still.values():
            value[100:] = value[100]  # at frame 100 the box is held, still on its way up
        fixed = replace(scene["object"], fixed_base=True)
        found = annotate_motion(replace(motion, **still), **{**scene, "object": fixed})
        ((first, last),) = intervals(found.object_contact[:, 0])
        assert 60 < first < 100
        assert last == motion.num_frames - 1

    def test_a_person_has_the_last_word(self, lift_box):
        motion, scene = lift_box
        overrides = Overrides(
            contacts={LEFT: (Interval(70, 100, (0.0, 0.1, 0.0)), Interval(120, 200)), RIGHT: ()},
            points={RIGHT: (0.0, -0.1, 0.0)},
        )
        found = annotate_motion(motion, **scene, overrides=overrides)
        assert intervals(found.object_contact[:, 0]) == [(70, 100), (120, 200)]
        assert not found.object_contact[:, 1].any()
        np.testing.assert_allclose(found.contact_points[85, 0], [0, 0.1, 0], atol=1e-6)
        np.testing.assert_allclose(found.contact_points[150, 0, 1], 0.14, atol=1e-4)
        np.testing.assert_allclose(found.contact_points[:, 1], [[0, -0.1, 0]] * 300, atol=1e-6)

    @pytest.mark.parametrize(
        ("overrides", "message"),
        [
            (Overrides(contacts={"left_hand": ()}), "no effectors"),
            (Overrides(contacts={LEFT: (Interval(10, 300),)}), "beyond the motion's 300 frames"),
            (Overrides(hinge={0: 0.0}), "has none"),
        ],
    )
    def test_overrides_that_do_not_fit(self, lift_box, overrides, message):
        motion, scene = lift_box
        with pytest.raises(MotionError, match=message):
            annotate_motion(motion, **scene, overrides=overrides)

    def test_object_trajectory_from_keyframes(self, lift_box):
        motion, scene = lift_box
        box = motion.body_names.index("box")
        truth = motion.body_pos_w[:, box]
        overrides = Overrides(object={t: (truth[t].tolist(), (1, 0, 0, 0)) for t in (0, 150)})
        alone = without_body(motion, "box")
        made = complete_object(alone, object=scene["object"], effectors=scene["effectors"], overrides=overrides)
        assert made.body_names[-1] == "box"
        error = np.linalg.norm(made.body_pos_w[:, -1] - truth, axis=-1)
        assert error.max() < 0.01
        assert np.ptp(made.body_pos_w[:70, -1], axis=0).max() < 1e-6
        bare = replace(alone, object_contact=None)
        fixed = replace(scene["object"], fixed_base=True)
        first = Overrides(object={0: overrides.object[0]})
        still = complete_object(bare, object=fixed, effectors=scene["effectors"], overrides=first)
        assert np.ptp(still.body_pos_w[:, -1], axis=0).max() == 0
        with pytest.raises(MotionError, match="needs contacts"):
            complete_object(bare, object=scene["object"], effectors=scene["effectors"], overrides=overrides)

    def test_a_hinge_that_is_added_goes_to_where_its_target_is(self, lift_box):
        motion, scene = lift_box
        lid = HingeConfig("lid", "panel", [{"box": (0.1, 0.1, 0.01)}])
        chest = replace(scene["object"], hinge=lid, fixed_base=True)
        given = replace(motion, joint_target=motion.joint_pos + np.float32(0.1))
        keyframes = Overrides(hinge={0: 0.0, 200: 0.5})
        made = complete_object(given, object=chest, effectors=scene["effectors"], overrides=keyframes)
        assert made.joint_names == (*motion.joint_names, "lid")
        np.testing.assert_array_equal(made.joint_target[:, -1], made.joint_pos[:, -1])
        np.testing.assert_array_equal(made.joint_target[:, :-1], given.joint_target)

    def test_hands_come_from_joints_in_any_order(self, lift_box):
        motion, scene = lift_box
        assert LEFT not in motion.body_names
        turned = replace(
            motion,
            joint_names=motion.joint_names[::-1],
            joint_pos=motion.joint_pos[:, ::-1].copy(),
            joint_vel=motion.joint_vel[:, ::-1].copy(),
        )
        box = motion.body_names.index("box")
        overrides = Overrides(object={0: (motion.body_pos_w[0, box], motion.body_quat_w[0, box])})
        scene = {key: scene[key] for key in ("object", "effectors")}
        made, again = (complete_object(without_body(m, "box"), **scene, overrides=overrides) for m in (motion, turned))
        assert np.ptp(made.body_pos_w[:, -1], axis=0).max() > 0.05  # it is carried
        np.testing.assert_allclose(made.body_pos_w, again.body_pos_w, atol=1e-9)

    def test_effectors_that_cannot_touch(self, lift_box):
        motion, scene = lift_box
        effectors = [Effector("left_wrist_roll_link")]
        with pytest.raises(MotionError, match="'left_wrist_roll_link' has no collision shape"):
            annotate_motion(motion, **{**scene, "effectors": effectors})

    def test_no_keyframes_and_no_object(self, lift_box):
        motion, scene = lift_box
        with pytest.raises(MotionError, match="lacks the task's object 'box'"):
            annotate_motion(without_body(motion, "box"), **scene)


def without_body(motion: Motion, name: str) -> Motion:
    kept = [i for i, other in enumerate(motion.body_names) if other != name]
    keys = ("body_pos_w", "body_quat_w", "body_lin_vel_w", "body_ang_vel_w")
    arrays = {key: getattr(motion, key)[:, kept] for key in keys}
    return replace(motion, body_names=tuple(motion.body_names[i] for i in kept), **arrays)


@pytest.fixture(scope="module")
def script() -> ModuleType:
    return annotate


class TestScript:
    def test_annotates_compares_and_obeys(self, script, lift_box, tmp_path, capsys):
        motion, _ = lift_box
        source = save_motion(motion, tmp_path / "lift_box")
        (source / "annotation.yaml").write_text(f"contacts: {{{RIGHT}: [{{frames: [80, 90]}}]}}", encoding="utf-8")
        assert script.main([str(source), f"out={tmp_path / 'out'}"]) == 0
        shown = capsys.readouterr().out
        assert "80-90" in shown
        assert "precision" in shown
        annotated = load_motion(tmp_path / "out")
        assert annotated.object_contact.shape == (300, 2)
        assert intervals(annotated.object_contact[:, 1]) == [(80, 90)]
        assert annotated.contact_points.shape == (300, 2, 3)

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [([], "one motion folder"), (["nowhere"], "no such file"), (["LIFT", "task=walk"], "no object to touch")],
    )
    def test_mistakes_end_with_one_line(self, script, arguments, message, capsys):
        arguments = [str(find_motion("lift_box")) if argument == "LIFT" else argument for argument in arguments]
        assert script.main(arguments) == 2
        assert message in capsys.readouterr().err
