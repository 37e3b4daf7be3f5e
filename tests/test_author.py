"""Authoring: the keyframe vocabulary, footsteps, balance, and plans solved end to end."""

from pathlib import Path

import numpy as np
import pytest
from mocks import load_config
from scipy.spatial.transform import Rotation

from hdmi.assembly import scene_parts
from hdmi.assets import Effector, ObjectConfig, SceneryConfig, g1, g1_robot
from hdmi.motion import find_motion, forward_kinematics, load_motion
from hdmi.motion.kinematics import minimum_jerk
from hdmi.workshop import ik
from hdmi.workshop.author import PlanError, author_motion, find_plan, load_plan, parse_plan
from hdmi.workshop.author.balance import COM_HEIGHT, GRAVITY, Load, centre_of_pressure, pendulum_com
from hdmi.workshop.author.footsteps import (
    ANKLE_HEIGHT,
    OVER_PLACE,
    SHIFT_TIME,
    SOLE_CENTRE,
    foot_path,
    footprints,
    plan_steps,
    root_path,
    stances,
)
from hdmi.workshop.author.footsteps import centre_of_pressure as planned_pressure
from hdmi.workshop.author.paths import PosePath, pose_path, value_path

FILE = Path("plans/try.yaml")
FPS = 50.0
HALF = 0.119  # of the stance's width, m
BOX = ObjectConfig("box", [{"box": (0.07, 0.14, 0.10)}], mass=0.5)
STAND = SceneryConfig("stand", [{"box": (0.14, 0.13, 0.34)}])
FINGERTIPS = (
    Effector("left_wrist_yaw_link", (0.15, -0.055, 0.0), (0.0, 0.14, 0.05)),
    Effector("right_wrist_yaw_link", (0.15, 0.055, 0.0), (0.0, -0.14, 0.05)),
)


def plan(**content):
    return parse_plan({"duration": 4.0, **content}, FILE)


def times(duration=4.0):
    return np.arange(round(duration * FPS)) / FPS


def keys(*items):
    return plan(object={"path": list(items)}).object_path


def still(*pos):
    return PosePath.fixed(pos, Rotation.identity(), len(times()))


class TestErrors:
    """Every message names the file and the key, and says what would be right."""

    @pytest.mark.parametrize(
        ("content", "fragments"),
        [
            ({"duration": "long"}, ["duration", "number", "'long'"]),
            ({"duration": float("nan")}, ["duration", "number"]),
            ({"dance": []}, ["unknown 'dance'", "duration, phases"]),
            ({"hands": {"left": [{"at": 1, "pos": [0, 0]}]}}, ["hands.left[0].pos", "3 numbers", "[0, 0]"]),
            ({"hands": {"left": [{"at": 1, "contact": 1}]}}, ["hands.left[0].contact", "true, false or here"]),
            ({"hands": {"left": [{"at": 1, "frame": "object", "contact": "here"}]}}, ["left[0].contact", "`pos`"]),
            ({"hands": {"left": [{"at": 1, "pos": [0, 0, 0], "contact": "here"}]}}, ["contact", "frame 'object'"]),
            ({"hands": {"both": [], "left": []}}, ["hands", "either 'both'"]),
            ({"hands": {"tail": []}}, ["hands", "unknown 'tail'", "left, right"]),
            ({"pelvis": [{"at": "jump", "height": 1}]}, ["pelvis[0].at", "no phase 'jump'"]),
            ({"pelvis": [{"at": 2}, {"at": 1}]}, ["pelvis[1].at", "1.0 s is not after", "2.0 s"]),
            ({"pelvis": {"at": 2}}, ["pelvis", "expected a list"]),
            ({"torso": [{"at": 0, "bow": 1}]}, ["torso[0]", "unknown 'bow'", "lean, gaze, roll"]),
            ({"feet": [{"start": 0}]}, ["feet[0]", "either 'walk' or 'step'"]),
            ({"feet": [{"walk": [[1, 0]], "start": 0, "end": 1}]}, ["feet[0].walk[0]", "3 numbers"]),
            ({"feet": [{"walk": [[1, 0, 0]], "start": 0, "end": 1, "step_time": 0}]}, ["feet[0]", "more than 0"]),
            ({"feet": [{"step": "tail", "start": 0, "end": 1, "to": [0, 0, 0]}]}, ["feet[0].step", "left or right"]),
            ({"feet": [{"step": "left", "start": 1, "end": 1, "to": [0, 0, 0]}]}, ["feet[0]", "is not after start"]),
            ({"object": {"carried": [0, 2, 1, 3]}}, ["object.carried", "must not decrease"]),
            ({"object": {"carried": [0, 1]}}, ["object.carried", "four times"]),
            ({"posture": {"tail_joint": 1}}, ["posture.tail_joint", "matches no joint"]),
        ],
    )
    def test_content(self, content, fragments):
        with pytest.raises(PlanError) as caught:
            plan(**content)
        for fragment in (str(FILE), *fragments):
            assert fragment in str(caught.value)

    def test_file(self, tmp_path):
        with pytest.raises(PlanError, match=r"none\.yaml: no such plan"):
            load_plan(tmp_path / "none.yaml")
        (tmp_path / "bad.yaml").write_text("duration: [1")
        with pytest.raises(PlanError, match=r"bad\.yaml: not YAML"):
            load_plan(tmp_path / "bad.yaml")
        with pytest.raises(PlanError, match=r"fly\.yaml: no such plan; there is .*lift_box"):
            find_plan("fly")

    def test_steps_that_are_too_quick(self):
        walk = {"walk": [[1, 0, 0]], "start": 0, "end": 1, "length": 0.25}
        with pytest.raises(PlanError, match=r"try\.yaml: feet\[0\]: 5 steps in 1\.00 s are 0\.20 s each"):
            plan_steps(plan(feet=[walk]))

    def test_steps_that_overlap(self):
        steps = [
            {"step": side, "start": i, "end": i + 1.5, "to": [0, 0, 0]} for i, side in enumerate(("left", "right"))
        ]
        with pytest.raises(PlanError, match=r"begins at 1\.0 s, before that of 1\.5 s ended"):
            plan_steps(plan(feet=steps))

    def test_plan_and_task_that_do_not_fit(self):
        with pytest.raises(PlanError, match="scenery: does not place 'stand'"):
            author_motion(plan(), scenery=[STAND])
        with pytest.raises(PlanError, match="scenery: the task has no stand"):
            author_motion(plan(scenery={"stand": {"pos": [1, 0, 0]}}))
        with pytest.raises(PlanError, match=r"object\.path: lacks the place of 'box'"):
            author_motion(plan(), BOX)
        with pytest.raises(PlanError, match=r"object\.hinge: 'box' has none"):
            author_motion(plan(object={"path": [{"at": 0}], "hinge": [{"at": 0, "angle": 1}]}), BOX)

    def test_unknown_frame(self):
        with pytest.raises(PlanError, match=r"try\.yaml: object\.path\[0\]: there is no frame 'moon'; there is world"):
            pose_path(keys({"at": 0, "frame": "moon"}), {"world": still(0, 0, 0)}, times())

    def test_out_of_reach(self):
        reach = [{"at": 0, "pos": [0.3, 0.2, 0.9]}, {"at": 0.2, "pos": [2, 0.2, 0.9]}]
        with pytest.raises(PlanError, match=r"out of reach: at 0\.\d+ s the left hand is .* m from"):
            author_motion(plan(duration=0.3, hands={"left": reach}, corrections=0))


class TestKeys:
    def test_minimum_jerk(self):
        np.testing.assert_allclose(minimum_jerk(np.array([-1, 0, 0.25, 0.5, 1, 2])), [0, 0, 0.103515625, 0.5, 1, 1])

    def test_values(self):
        pelvis = plan(pelvis=[{"at": 1, "height": 0.7}, {"at": 2, "height": 0.5, "pitch": 0.2}, {"at": 3}]).pelvis
        height = value_path(pelvis, "height", times(), 0.0)
        np.testing.assert_allclose(height[[0, 50, 75, 100, 150, 199]], [0.7, 0.7, 0.6, 0.5, 0.5, 0.5])
        assert value_path((), "height", times(), 0.8)[7] == 0.8

    def test_phases_are_times(self):
        assert plan(phases={"lift": 1.5}, pelvis=[{"at": "lift"}]).pelvis[0].time == 1.5

    def test_a_key_takes_over_what_it_does_not_name(self):
        first = {"at": 0, "frame": "torso", "pos": [1, 2, 3], "rpy": [0, 0, 1], "gap": 0.1, "contact": True}
        _, same, other = keys(first, {"at": 1}, {"at": 2, "frame": "root"})
        assert (same.frame, same.pos, same.rpy, same.gap, same.contact) == ("torso", (1, 2, 3), (0, 0, 1), 0.1, True)
        assert (other.frame, other.pos, other.rpy) == ("root", None, (0, 0, 1))

    def test_both_hands_are_mirror_images(self):
        both = {"at": 0, "pos": [1, 2, 3], "rpy": [0.1, 0.2, 0.3], "out": [0, 1, 0], "gap": 0.1}
        hands = plan(hands={"both": [both]}).hands
        assert hands["left"][0].pos == (1, 2, 3)
        right = hands["right"][0]
        assert (right.pos, right.rpy, right.out, right.gap) == ((1, -2, 3), (-0.1, 0.2, -0.3), (0, -1, 0), 0.1)

    def test_contact_here(self):
        here = {"at": 0, "frame": "object", "pos": [1, 2, 3], "contact": "here"}
        hand = plan(hands={"left": [here, {"at": 1}, {"at": 2, "contact": False}]}).hands["left"]
        assert [(key.contact, key.here) for key in hand] == [(True, True), (True, True), (False, False)]

    def test_a_key_moves_with_its_frame(self):
        moving = PosePath(np.outer(times(), [1.0, 0, 0]), Rotation.from_euler("z", np.full((200, 1), np.pi / 2)))
        path, _ = pose_path(keys({"at": 0, "frame": "cart", "pos": [0.5, 0, 0]}), {"cart": moving}, times())
        np.testing.assert_allclose(path.pos[100], [2.0, 0.5, 0.0], atol=1e-12)

    def test_attached_it_stays_where_it_is_and_moves_with_the_frame_until_it_is_attached_to_another(self):
        t = times()
        share = minimum_jerk(t - 1.5)  # the cart moves 1 m and turns 1 rad between 1.5 s and 2.5 s
        cart = PosePath(share[:, None] * [1.0, 0, 0], Rotation.from_rotvec(share[:, None] * [0, 0, 1.0]))
        held = keys({"at": 0, "pos": [0.4, 0.1, 0.8]}, {"at": 1, "attach": "cart"}, {"at": 3, "attach": "world"})
        path, _ = pose_path(held, {"world": still(0, 0, 0), "cart": cart}, t)
        in_cart = cart.rot.inv().apply(path.pos - cart.pos)
        np.testing.assert_allclose(in_cart[50:151], np.tile([0.4, 0.1, 0.8], (101, 1)), atol=1e-9)
        np.testing.assert_allclose(path.pos[:75], np.tile([0.4, 0.1, 0.8], (75, 1)), atol=1e-9)
        np.testing.assert_allclose(path.pos[150:], path.pos[150:151].repeat(50, 0), atol=1e-9)
        assert np.linalg.norm(np.diff(path.pos, axis=0), axis=1).max() < 0.06  # no jump

    def test_contact_begins_at_the_surface(self):
        # from 5 cm outside to 5 cm inside: at the surface half way
        hand = keys(
            {"at": 1, "out": [0, 1, 0], "gap": 0.05}, {"at": 2, "gap": -0.05, "contact": True}, {"at": 3},
            {"at": 3.5, "gap": 0.05, "contact": False},
        )  # fmt: skip
        _, contact = pose_path(hand, {"world": still(0, 0, 0)}, times(), target=(1.0, 2.0, 3.0))
        assert np.flatnonzero(contact).tolist() == list(range(75, 163))


class TestFootsteps:
    def test_a_walk_straight_ahead(self):
        walk = {"walk": [[0.5, 0, 0]], "start": 0.5, "end": 3.5, "length": 0.25, "step_time": 1}
        steps = plan_steps(plan(feet=[walk]))
        assert [step.side for step in steps] == ["left", "right", "left"]
        np.testing.assert_allclose([step.to for step in steps], [[0.25, HALF, 0], [0.5, -HALF, 0], [0.5, HALF, 0]])
        np.testing.assert_allclose([(step.start, step.end) for step in steps], [(0.75, 1.5), (1.75, 2.5), (2.75, 3.5)])

    def test_a_turn_to_the_right_begins_with_the_right_foot(self):
        walk = {"walk": [[0, 0, -0.8]], "start": 0, "end": 3, "turn": 0.4, "step_time": 1}
        steps = plan_steps(plan(feet=[walk]))
        assert [step.side for step in steps] == ["right", "left", "right"]
        np.testing.assert_allclose(steps[0].to, [-HALF * np.sin(0.4), -HALF * np.cos(0.4), -0.4])

    def test_there_are_as_many_steps_as_there_is_time_for(self):
        walk = {"walk": [[0.5, 0, 0], [0.5, 0, 0.4]], "start": 0, "end": 4.5, "length": 0.25, "turn": 0.4}
        steps = plan_steps(plan(feet=[walk | {"step_time": 0.5}]))
        np.testing.assert_allclose([step.end for step in steps], np.arange(0.5, 4.6, 0.5))
        turned = [step.to[2] for step in steps]  # five ahead and three turns, from 2 and 1, and one to stand
        np.testing.assert_allclose(turned, [0, 0, 0, 0, 0, 0.4 / 3, 0.8 / 3, 0.4, 0.4], atol=1e-12)
        assert steps[0].to[0] == pytest.approx(0.1)

    def test_a_foot_is_over_its_place_before_it_comes_down(self):
        content = plan(feet=[{"step": "left", "start": 0.5, "end": 1.0, "to": [0.2, HALF, 0], "height": 0.06}])
        steps, t = plan_steps(content), times()
        prints = footprints(content, steps, t)
        path, _ = foot_path(content, "left", steps, prints["left"], t, {})
        late = np.flatnonzero((t > 0.5 + OVER_PLACE * 0.5) & (t < 1.0))
        assert len(late) >= 3
        np.testing.assert_allclose(path.pos[late, 0], 0.2, atol=1e-9)
        # and still in the air: 16 (u (1 - u))^2 of the step's height, at u = 0.92
        np.testing.assert_allclose(path.pos[48, 2], ANKLE_HEIGHT + 0.06 * 16 * 0.0736**2, atol=1e-6)
        half = np.flatnonzero(np.isclose(t, 0.74) | np.isclose(t, 0.76))
        np.testing.assert_allclose(path.pos[half, 2], ANKLE_HEIGHT + 0.06, atol=1e-3)
        with_a_way = {
            "step": "left",
            "start": 0.5,
            "end": 1.0,
            "to": [0.2, HALF, 0],
            "via": [{"at": 0.7, "pos": [0.1, HALF, 0.2]}],
        }
        slow = footprints(content, plan_steps(plan(feet=[with_a_way])), t)
        assert slow["left"][late, 0].max() < 0.2

    def test_a_walk_continues_where_the_feet_are(self):
        first = {"walk": [[0.2, 0, 0]], "start": 0, "end": 1}
        steps = plan_steps(plan(feet=[first, {"walk": [[0.4, 0, 0]], "start": 2, "end": 3}]))
        assert [step.to[0] for step in steps] == pytest.approx([0.2, 0.2, 0.4, 0.4])

    def test_pressure_is_under_the_foot_that_stands(self):
        content = plan(feet=[{"walk": [[0.5, 0, 0]], "start": 0.5, "end": 3.3, "length": 0.25}])
        steps, t = plan_steps(content), times()
        prints = footprints(content, steps, t)
        ground = stances(steps, t)
        pressure = planned_pressure(content, steps, prints, t)
        assert set(np.flatnonzero(~ground["left"])).isdisjoint(np.flatnonzero(~ground["right"]))
        for swinging, standing in (("left", "right"), ("right", "left")):
            air = ~ground[swinging]
            assert air.sum() > 30
            np.testing.assert_allclose(pressure[air, :2], prints[standing][air, :2] + [SOLE_CENTRE, 0], atol=1e-9)
        np.testing.assert_allclose(pressure[0], [SOLE_CENTRE, 0, 0], atol=1e-9)
        np.testing.assert_allclose(pressure[-1], [0.5 + SOLE_CENTRE, 0, 0], atol=1e-9)
        assert steps[-1].end + SHIFT_TIME <= t[-1] + 0.02

    def test_the_root_goes_straight_between_the_feet(self):
        content = plan(feet=[{"walk": [[0.5, 0, 0]], "start": 0.5, "end": 3.0, "length": 0.25}])
        root = root_path(footprints(content, plan_steps(content), times()), times())
        np.testing.assert_allclose(root.pos[:, 1:], 0, atol=1e-9)
        assert (np.diff(root.pos[:, 0]) > -1e-9).all()
        np.testing.assert_allclose(root.pos[-1, 0], 0.5, atol=1e-3)


class TestBalance:
    def test_pendulum(self):
        t, rate = times(), 2 * np.pi
        pressure = np.column_stack([np.full(200, 0.3), np.cos(rate * t)])
        com = pendulum_com(pressure, FPS)
        np.testing.assert_allclose(com[:, 0], 0.3)
        # c = A cos(w t) solves c - (h / g) c'' = p for A = 1 / (1 + (h / g) w^2), away from the ends
        expected = np.cos(rate * t) / (1 + COM_HEIGHT / GRAVITY * rate**2)
        np.testing.assert_allclose(com[80:120, 1], expected[80:120], atol=1e-2)

    def test_standing_still_the_pressure_is_under_the_centre_of_mass(self):
        qpos = np.tile(ik.standing(), (30, 1))
        nothing = Load(*(np.zeros(shape) for shape in ((30, 3), (30,), (30, 3), (30, 3))))
        pressure = centre_of_pressure(qpos, nothing, np.zeros(30), FPS)
        com = pressure[15]
        np.testing.assert_allclose(pressure, np.tile(com, (30, 1)), atol=1e-9)
        # a tenth of its mass carried 1 m ahead of the centre of mass moves it by 1 / 11 m
        ahead = np.tile([com[0] + 1.0, com[1], 0.8], (30, 1))
        carrying = Load(ahead, np.full(30, g1.TOTAL_MASS / 10), np.zeros((30, 3)), np.zeros((30, 3)))
        np.testing.assert_allclose(
            centre_of_pressure(qpos, carrying, np.zeros(30), FPS)[15], [com[0] + 1 / 11, com[1]], atol=1e-6
        )
        # pushed back with 30 N at a height of 0.8 m
        push = Load(np.zeros((30, 3)), np.zeros(30), np.tile([-30.0, 0, 0], (30, 1)), np.tile([0.4, 0, 0.8], (30, 1)))
        shift = 30 * 0.8 / (g1.TOTAL_MASS * GRAVITY)
        np.testing.assert_allclose(
            centre_of_pressure(qpos, push, np.zeros(30), FPS)[15], [com[0] - shift, com[1]], atol=1e-6
        )


@pytest.mark.parametrize("path", sorted(find_motion("lift_box").parent.iterdir()), ids=lambda path: path.name)
def test_a_reference_that_ships_is_what_its_plan_says(path):
    content, motion = load_plan(find_plan(path.name)), load_motion(path)
    assert motion.num_frames == round(content.duration * FPS)
    t = np.arange(motion.num_frames) / FPS
    root = root_path(footprints(content, plan_steps(content), t), t)
    np.testing.assert_allclose(motion.body_pos_w[:, 0, :2], root.pos[:, :2], atol=0.35)
    for name, key in content.scenery.items():
        np.testing.assert_allclose(motion.body_pos_w[0, motion.body_names.index(name)], key.pos, atol=1e-5)


class TestMotions:
    @pytest.fixture(scope="class")
    def authored(self):
        """Takes a box along for a small step."""
        content = plan(
            duration=2.4,
            feet=[{"walk": [[0.1, 0, 0]], "start": 0.7, "end": 1.8}],
            hands={"both": [{"at": 0, "frame": "object", "out": [0, 1, 0], "gap": -0.01, "contact": True}]},
            object={"carried": [0, 0, 9, 9], "path": [{"at": 0, "pos": [0.35, 0, 0.9]}, {"at": 0.1, "attach": "root"}]},
        )
        return author_motion(content, BOX, (), FINGERTIPS)

    def test_it_is_near_its_plan(self, authored):
        assert authored.unsettled == 0
        assert max(miss for name, miss in authored.misses.items() if name != "centre of mass") < 0.005
        assert authored.speed < 0.7
        assert authored.pressure_error < 0.02

    def test_feet_are_on_the_ground(self, authored):
        motion = authored.motion
        pos, _ = forward_kinematics(g1_robot(), motion.body_pos_w[:, 0], motion.body_quat_w[:, 0], motion.joint_pos)
        feet = pos[:, [g1.BODY_NAMES.index(foot) for foot in g1.FEET]]
        assert feet[..., 2].min() > ANKLE_HEIGHT - 1e-3
        assert (feet[..., 2].min(axis=1) < ANKLE_HEIGHT + 1e-3).all()  # never both in the air
        np.testing.assert_allclose(feet[-1, :, 0], 0.1, atol=1e-3)

    def test_the_box_stays_in_the_hands(self, authored):
        motion = authored.motion
        assert motion.object_contact.all()
        box = motion.body_pos_w[:, motion.body_names.index("box")]
        assert box[-1, 0] == pytest.approx(0.45, abs=1e-3)
        pos, quat = forward_kinematics(g1_robot(), motion.body_pos_w[:, 0], motion.body_quat_w[:, 0], motion.joint_pos)
        for effector, inside in zip(FINGERTIPS, ([0, -0.01, 0], [0, 0.01, 0]), strict=True):
            b = g1.BODY_NAMES.index(effector.body)
            point = pos[:, b] + Rotation.from_quat(quat[:, b], scalar_first=True).apply(effector.point)
            expected = np.add(effector.target, inside)
            np.testing.assert_allclose(point - box, np.tile(expected, (len(box), 1)), atol=5e-3)

    def test_contact_points_are_the_task_s_or_where_the_plan_says(self):
        here = {"at": 0, "frame": "object", "pos": [0.02, 0.14, -0.02], "contact": "here"}
        content = {"duration": 0.1, "corrections": 0, "object": {"path": [{"at": 0, "pos": [0.35, 0, 0.9]}]}}
        made = author_motion(plan(**content, hands={"left": [here]}), BOX, (), FINGERTIPS).motion
        np.testing.assert_allclose(made.contact_points, [[(0.02, 0.14, -0.02), FINGERTIPS[1].target]] * 5, atol=1e-6)
        np.testing.assert_array_equal(made.object_contact, [[True, False]] * 5)

    def test_each_contact_has_a_point_where_the_plan_says(self):
        here = {"at": 0, "frame": "object", "pos": [0.02, 0.14, -0.02], "contact": "here"}
        content = {"duration": 0.1, "corrections": 0, "object": {"path": [{"at": 0, "pos": [0.35, 0, 0.9]}]}}
        elsewhere = {**here, "at": 0.05, "pos": [0, 0.14, 0]}
        with pytest.raises(PlanError, match=r"left\[1\].pos: a contact 'here' has one point, \(0.02, 0.14"):
            plan(**content, hands={"left": [here, elsewhere]})
        between = {"at": 0.02, "gap": 0.01, "contact": False}
        made = author_motion(plan(**content, hands={"left": [here, between, elsewhere]}), BOX, (), FINGERTIPS).motion
        # of the contacts at 0 and at 0.05 s the nearest one's
        expected = [(0.02, 0.14, -0.02)] * 2 + [(0, 0.14, 0)] * 3
        np.testing.assert_allclose(made.contact_points[:, 0], expected, atol=1e-6)

    def test_lift_box_is_what_its_plan_makes(self):
        parts = scene_parts(load_config())
        made = author_motion(
            load_plan(find_plan("lift_box")), parts["object"], parts["scenery"], parts["effectors"]
        ).motion
        shipped = load_motion(find_motion("lift_box"))
        np.testing.assert_allclose(made.joint_pos, shipped.joint_pos, atol=1e-3)
        np.testing.assert_allclose(made.body_pos_w[:, 0], shipped.body_pos_w[:, 0], atol=1e-3)
        np.testing.assert_array_equal(made.object_contact, shipped.object_contact)
        for body in ("box", "stand"):
            rows = made.body_names.index(body), shipped.body_names.index(body)
            np.testing.assert_array_equal(made.body_pos_w[:, rows[0]], shipped.body_pos_w[:, rows[1]])
