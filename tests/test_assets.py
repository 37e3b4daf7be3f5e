"""The robot, objects and scenes as MuJoCo compiles them."""

import math
import os

import mujoco
import numpy as np
import pytest
import trimesh

from hdmi.assets import (
    Effector,
    GeomConfig,
    HingeConfig,
    ObjectConfig,
    RobotConfig,
    SceneryConfig,
    SimConfig,
    build_scene,
    default_joint_pos,
    g1,
    g1_robot,
    match_names,
    per_joint,
)
from hdmi.assets.mesh import load_mesh
from hdmi.motion import forward_kinematics

UPRIGHT = (1.0, 0.0, 0.0, 0.0)
QUARTER_Z = (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))
BOX = {"box": (0.1, 0.2, 0.3)}


def scene_with(object=None, robot=None, **kwargs):
    return build_scene(robot or RobotConfig(), SimConfig(), object, **kwargs)


def geom_names(model):
    return {model.geom(i).name for i in range(model.ngeom)}


def vertices(model, data, geom):
    """World positions of a mesh geom's vertices, as simulated."""
    mesh = model.geom_dataid[geom]
    start, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    local = model.mesh_vert[start : start + count]
    return local @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]


class TestRobot:
    def test_has_the_tables_joints_in_order(self, robot_scene):
        model = robot_scene.model
        assert (model.nu, model.nq, model.nv) == (29, 7 + 29, 6 + 29)
        assert [model.actuator(i).name for i in range(29)] == list(g1.JOINT_NAMES)
        assert [model.joint(model.dof_jntid[dof]).name for dof in robot_scene.joint_dof] == list(g1.JOINT_NAMES)
        assert [model.body(i).name for i in robot_scene.body_ids] == list(g1.BODY_NAMES)
        # 3.813 kg of pelvis, 8.118 of waist and torso, 7.186 of each leg, 3.519021 of each arm
        assert model.body_mass.sum() == pytest.approx(33.341142, abs=1e-6)

    def test_figures_of_a_joint(self, robot_scene):
        model = robot_scene.model
        i = model.actuator("left_hip_pitch_joint").id
        dof = model.jnt_dofadr[model.joint("left_hip_pitch_joint").id]
        # armature 0.01017752 at 10 Hz, damping ratio 2: a (20 pi)^2 and 4 a 20 pi
        assert model.actuator_gainprm[i, 0] == pytest.approx(40.1792, abs=1e-4)
        assert model.actuator_biasprm[i, 1] == pytest.approx(-40.1792, abs=1e-4)
        assert model.dof_damping[dof] == pytest.approx(2.55789, abs=1e-5)
        assert model.dof_armature[dof] == pytest.approx(0.01017752)
        assert model.actuator_forcerange[i].tolist() == [-88.0, 88.0]
        assert model.joint("left_hip_pitch_joint").range.tolist() == pytest.approx([-2.5307, 2.8798])

    def test_limits_are_the_tables(self, robot_scene):
        model = robot_scene.model
        for joint in g1.JOINTS:
            assert model.joint(joint.name).range.tolist() == pytest.approx(joint.range), joint.name
            force = model.actuator_forcerange[model.actuator(joint.name).id]
            assert force.tolist() == [-joint.effort_limit, joint.effort_limit], joint.name

    def test_torque_stops_at_the_effort_limit(self, robot_scene, pose):
        data = pose(robot_scene, height=3.0)
        data.ctrl[:] = data.qpos[robot_scene.joint_qpos] + 100.0
        mujoco.mj_forward(robot_scene.model, data)
        np.testing.assert_allclose(data.actuator_force, [joint.effort_limit for joint in g1.JOINTS])

    def test_stiffness_override_keeps_damping(self, robot_scene):
        model = scene_with(robot=RobotConfig(stiffness={".*_knee_joint": 250.0})).model
        knee = model.actuator("left_knee_joint").id
        assert model.actuator_gainprm[knee, 0] == 250.0
        assert model.actuator_biasprm[knee, 1] == -250.0
        np.testing.assert_array_equal(model.dof_damping, robot_scene.model.dof_damping)
        others = [i for i in range(29) if "knee" not in model.actuator(i).name]
        np.testing.assert_array_equal(model.actuator_gainprm[others], robot_scene.model.actuator_gainprm[others])

    def test_damping_override(self, robot_scene):
        model = scene_with(robot=RobotConfig(damping={"waist_.*_joint": 5.0})).model
        waist = [model.jnt_dofadr[model.joint(f"waist_{axis}_joint").id] for axis in ("yaw", "roll", "pitch")]
        assert model.dof_damping[waist].tolist() == [5.0, 5.0, 5.0]
        others = np.setdiff1d(np.arange(model.nv), waist)
        np.testing.assert_array_equal(model.dof_damping[others], robot_scene.model.dof_damping[others])
        np.testing.assert_array_equal(model.actuator_gainprm, robot_scene.model.actuator_gainprm)

    def test_a_scene_moves_the_robot_as_forward_kinematics_does(self, robot_scene, pose):
        joint_pos = np.random.default_rng(0).uniform(-0.5, 0.5, 29)
        data = pose(robot_scene, joint_pos)
        pos, quat = forward_kinematics(g1_robot(), data.qpos[None, :3], data.qpos[None, 3:7], joint_pos[None])
        np.testing.assert_allclose(data.xpos[robot_scene.body_ids], pos[0], atol=1e-9)
        np.testing.assert_allclose(data.xquat[robot_scene.body_ids], quat[0], atol=1e-9)

    def test_zero_pose_by_hand(self, robot_scene, pose):
        data = pose(robot_scene, np.zeros(29), height=1.0)
        # pelvis + waist_yaw + waist_roll + torso offsets
        torso = data.xpos[robot_scene.model.body("torso_link").id]
        np.testing.assert_allclose(torso, [-0.0039635, 0.0, 1.044], atol=1e-9)

    def test_default_pose_is_mirrored_and_on_the_floor(self, robot_scene, pose):
        data = pose(robot_scene)
        left, right = (data.xpos[robot_scene.model.body(foot).id] for foot in g1.FEET)
        np.testing.assert_allclose(left * [1, -1, 1], right, atol=1e-4)
        spheres = [i for i in range(robot_scene.model.ngeom) if "_foot" in robot_scene.model.geom(i).name]
        lowest = min(data.geom_xpos[i, 2] - robot_scene.model.geom_rbound[i] for i in spheres)
        assert abs(lowest) < 0.01

    def test_standing_feet_carry_the_weight(self, robot_scene, pose):
        model, data = robot_scene.model, pose(robot_scene)
        for _ in range(80):
            mujoco.mj_step(model, data)
        force = data.sensordata[robot_scene.foot_sensors]
        weight = model.body_mass.sum() * 9.81
        assert np.linalg.norm(force.sum(0)) == pytest.approx(weight, rel=0.1)
        assert np.linalg.norm(force[0]) == pytest.approx(np.linalg.norm(force[1]), rel=0.1)
        assert data.qpos[2] == pytest.approx(g1.ROOT_HEIGHT, abs=0.03)

    def test_no_foot_force_in_the_air(self, robot_scene, pose):
        data = pose(robot_scene, height=2.0)
        assert not data.sensordata[robot_scene.foot_sensors].any()

    def test_box_feet_span_the_spheres(self, robot_scene):
        box = scene_with(robot=RobotConfig(feet="box")).model
        assert {name for name in geom_names(box) if "_foot" in name} == {"left_foot_collision", "right_foot_collision"}
        assert sum("_foot" in name for name in geom_names(robot_scene.model)) == 8
        geom = box.geom("left_foot_collision")
        # sphere centres +- their radius; the sole is where the spheres touch the floor
        np.testing.assert_allclose((geom.pos - geom.size)[:2], [-0.055, -0.035], atol=1e-9)
        np.testing.assert_allclose((geom.pos + geom.size)[:2], [0.125, 0.035], atol=1e-9)
        assert (geom.pos - geom.size)[2] == pytest.approx(-0.035)

    def test_effectors(self, robot_scene):
        hand = scene_with(robot=RobotConfig(effector="hand")).model
        hook = scene_with(robot=RobotConfig(effector="L")).model
        capsule, box = mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_BOX
        assert robot_scene.model.geom("left_hand_collision").type[0] == capsule
        assert hand.geom("left_hand_collision").type[0] == box
        assert hook.geom("right_hand_collision").type[0] == capsule
        assert {"left_L0_collision", "left_L1_collision", "right_L0_collision"} <= geom_names(hook)
        for model in (hand, hook):
            assert model.body_mass.sum() == pytest.approx(33.341142, abs=1e-6)

    @pytest.mark.parametrize("field", ["feet", "effector"])
    def test_unknown_kind_is_an_error(self, field):
        with pytest.raises(ValueError, match=rf"robot.{field}.*'claw'"):
            scene_with(robot=RobotConfig(**{field: "claw"}))

    def test_unknown_stiffness_pattern_is_an_error(self):
        with pytest.raises(ValueError, match=r"robot.stiffness: 'left_tail_.*' matches none"):
            scene_with(robot=RobotConfig(stiffness={"left_tail_.*": 1.0}))

    def test_missing_mesh_is_an_error(self, tmp_path):
        with pytest.raises(FileNotFoundError, match=r"robot.mesh_dir: .* has no pelvis.STL"):
            scene_with(robot=RobotConfig(mesh_dir=str(tmp_path)))

    def test_meshes_are_only_for_the_eye(self, tmp_path, robot_scene):
        for name in g1.BODY_NAMES:
            trimesh.creation.box((0.1, 0.1, 0.1)).export(tmp_path / f"{name}.STL")
        model = scene_with(robot=RobotConfig(mesh_dir=str(tmp_path))).model
        assert model.nmesh == len(g1.BODY_NAMES)
        shown = model.geom_type == mujoco.mjtGeom.mjGEOM_MESH
        assert not model.geom_contype[shown].any()
        assert not model.geom_conaffinity[shown].any()
        np.testing.assert_allclose(model.body_mass, robot_scene.model.body_mass)

    def test_friction(self):
        model = scene_with(robot=RobotConfig(friction=0.35)).model
        assert model.geom("left_hand_collision").friction[0] == 0.35

    @pytest.mark.parametrize("collide", [False, True])
    def test_self_collisions_are_a_choice(self, collide, pose):
        scene = scene_with(robot=RobotConfig(self_collisions=collide))
        crossed = per_joint({"left_hip_roll_joint": -0.5, "right_hip_roll_joint": 0.5}, g1.JOINT_NAMES)
        data = pose(scene, crossed, height=3.0)
        pairs = [{scene.model.geom(g).name.split("_")[0] for g in contact.geom} for contact in data.contact]
        assert ({"left", "right"} in pairs) == collide
        assert collide or not pairs


class TestNames:
    NAMES = ("left_knee", "left_hip", "right_knee")

    def test_indices_keep_the_order_of_names(self):
        assert match_names([".*_knee", "left_.*"], self.NAMES) == [0, 1, 2]
        assert match_names(["right_knee", "left_knee"], self.NAMES) == [0, 2]

    def test_patterns_match_whole_names(self):
        with pytest.raises(ValueError, match="'knee' matches none"):
            match_names(["knee"], self.NAMES)

    def test_error_names_place_pattern_and_choices(self):
        with pytest.raises(ValueError, match=r"task\.bodies: 'tail' matches none of .*left_knee"):
            match_names(["left_hip", "tail"], self.NAMES, where="task.bodies")

    def test_per_joint_last_pattern_wins(self):
        values = per_joint({".*_hip_.*": 2.0, "left_hip_roll_joint": 3.0}, g1.JOINT_NAMES, default=1.0)
        assert values[g1.JOINT_NAMES.index("left_hip_roll_joint")] == 3.0
        assert values[g1.JOINT_NAMES.index("right_hip_roll_joint")] == 2.0
        assert values[g1.JOINT_NAMES.index("left_elbow_joint")] == 1.0
        assert values.shape == (29,)

    def test_default_pose(self):
        pose = dict(zip(g1.JOINT_NAMES, default_joint_pos(), strict=True))
        assert pose["left_knee_joint"] == pose["right_knee_joint"] == 0.669
        assert pose["left_shoulder_roll_joint"] == -pose["right_shoulder_roll_joint"] == 0.2
        assert pose["waist_yaw_joint"] == 0.0
        low, high = np.array([joint.range for joint in g1.JOINTS]).T
        assert ((default_joint_pos() > low) & (default_joint_pos() < high)).all()


class TestObjects:
    def test_rigid_object_floats_at_its_placement(self):
        config = ObjectConfig("crate", [GeomConfig(**BOX)], mass=2.5, friction=0.4)
        scene = scene_with(config, placements={"crate": ((1.0, 2.0, 0.3), QUARTER_Z)})
        model, start = scene.model, scene.object_free_qpos
        assert model.body_mass[scene.object_body] == pytest.approx(2.5)
        np.testing.assert_allclose(model.qpos0[start : start + 7], [1.0, 2.0, 0.3, *QUARTER_Z], atol=1e-6)
        assert scene.object_link == scene.object_body
        assert (scene.num_object_joints, scene.object_hinge_qpos, len(scene.object_geoms)) == (0, None, 1)
        assert model.geom_friction[scene.object_geoms[0], 0] == 0.4
        # of a solid box: m (b^2 + c^2) / 3 with half extents
        inertia = sorted(2.5 / 3 * np.array([0.13, 0.10, 0.05]))
        np.testing.assert_allclose(sorted(model.body_inertia[scene.object_body]), inertia, rtol=1e-6)

    @pytest.mark.parametrize(("combine", "friction"), [("max", 0.9), ("object", 0.3)])
    def test_friction_of_a_pair(self, combine, friction, pose):
        """A hand inside a smooth object, and that object on the floor."""
        config = ObjectConfig("crate", [GeomConfig(**BOX)], friction=0.3, friction_combine=combine)
        hand = (0.25, 0.15, 0.29)
        scene = scene_with(config, RobotConfig(friction=0.9), placements={"crate": (hand, UPRIGHT)})
        data = pose(scene)
        hands = [i for i in range(scene.model.ngeom) if scene.model.geom(i).name.endswith("_hand_collision")]
        data.qpos[scene.object_free_qpos :][:3] = data.geom_xpos[hands[0]]
        mujoco.mj_forward(scene.model, data)
        pairs = {tuple(sorted(scene.model.geom(int(g)).name for g in c.geom)): c.friction[0] for c in data.contact}
        assert pairs["crate_geom0", "left_hand_collision"] == friction
        data.qpos[scene.object_free_qpos :][:3] = [3.0, 0.0, 0.29]
        mujoco.mj_forward(scene.model, data)
        pairs = {tuple(sorted(scene.model.geom(int(g)).name for g in c.geom)): c.friction[0] for c in data.contact}
        assert pairs["crate_geom0", "floor"] == 0.3

    def test_unknown_friction_combine(self):
        with pytest.raises(ValueError, match="friction_combine is 'max' or 'object', got 'product'"):
            ObjectConfig("crate", [BOX], friction_combine="product")

    def test_mass_is_spread_by_volume(self):
        geoms = [
            {"box": (0.1, 0.1, 0.1)},  # 8 l
            {"sphere": 0.1, "pos": (0, 0, 1)},  # 4.18879 l
            {"cylinder": (0.1, 0.2), "pos": (0, 0, 2)},  # 12.56637 l
            {"capsule": (0.1, 0.2), "pos": (0, 0, 3)},  # 16.75516 l
        ]
        scene = scene_with(ObjectConfig("tower", geoms, mass=41.51032))
        assert scene.model.body_mass[scene.object_body] == pytest.approx(41.51032)
        centre = (4.18879 * 1 + 12.56637 * 2 + 16.75516 * 3) / 41.51032
        np.testing.assert_allclose(scene.model.body_ipos[scene.object_body], [0, 0, centre], atol=1e-5)

    def test_body_quat_turns_a_geom_about_the_origin(self):
        geom = {"box": (0.1, 0.2, 0.3), "pos": (1.0, 0.0, 0.0), "body_quat": QUARTER_Z}
        scene = scene_with(ObjectConfig("crate", [geom]))
        data = mujoco.MjData(scene.model)
        mujoco.mj_kinematics(scene.model, data)
        where = scene.object_geoms[0]
        np.testing.assert_allclose(data.geom_xpos[where], [0, 1, 0], atol=1e-9)
        np.testing.assert_allclose(data.geom_xmat[where].reshape(3, 3)[:, 0], [0, 1, 0], atol=1e-9)

    def test_fixed_object_has_no_degrees_of_freedom(self, robot_scene):
        scene = scene_with(ObjectConfig("wall", [BOX], fixed_base=True), placements={"wall": ((2, 0, 1), UPRIGHT)})
        assert scene.object_free_qpos is None
        assert scene.model.nv == robot_scene.model.nv
        np.testing.assert_allclose(scene.model.body("wall").pos, [2, 0, 1])

    def test_articulated_object(self, robot_scene, pose):
        hinge = HingeConfig(
            name="door_joint",
            body="leaf",
            geoms=[{"box": (0.4, 0.02, 1.0), "pos": (0.4, 0.0, 1.1)}],
            pos=(0.1, 0.0, 0.0),
            range=(0.0, 1.2),
            friction=0.7,
            damping=0.3,
        )
        config = ObjectConfig("door", [{"box": (0.2, 0.05, 1.0)}], mass=6.0, hinge=hinge, fixed_base=True)
        scene = scene_with(config, placements={"door": ((3.0, 0.0, 0.0), UPRIGHT)})
        model = scene.model
        assert model.nv == robot_scene.model.nv + 1
        assert model.body_mass[scene.object_link] == pytest.approx(6.0)
        assert model.body(scene.object_link).name == "leaf"
        assert model.body(scene.object_body).name == "door"
        assert scene.num_object_joints == 1
        assert model.joint("door_joint").range.tolist() == pytest.approx([0.0, 1.2])
        assert model.dof_frictionloss[scene.object_hinge_dof] == 0.7
        assert model.dof_damping[scene.object_hinge_dof] == 0.3
        assert len(scene.object_geoms) == 2

        data = pose(scene, height=5.0)
        assert data.ncon == 0  # the leaf overlaps its frame
        data.qpos[scene.object_hinge_qpos] = 1.0
        mujoco.mj_kinematics(model, data)
        centre = data.xipos[scene.object_link]
        np.testing.assert_allclose(centre, [3.1 + 0.4 * np.cos(1), 0.4 * np.sin(1), 1.1], atol=1e-9)

    def test_floating_articulated_object_keeps_its_mass(self):
        config = ObjectConfig("chair", [BOX], mass=4.0, hinge={"name": "fold", "body": "back", "geoms": [BOX]})
        scene = scene_with(config)
        masses = scene.model.body_mass[[scene.object_body, scene.object_link]]
        assert masses.sum() == pytest.approx(4.0)
        assert (masses > 0).all()
        assert scene.object_free_qpos is not None

    @pytest.mark.parametrize("mass", [0.0, -1.0, float("nan")])
    def test_bad_mass_is_an_error(self, mass):
        with pytest.raises(ValueError, match="'crate': mass: 1 positive number"):
            ObjectConfig("crate", [BOX], mass=mass)

    @pytest.mark.parametrize(
        "geom",
        [
            {},
            {"box": (0.1, 0.1, 0.1), "sphere": 0.1},
            {"box": (0.1, 0.0, 0.1)},
            {"box": (0.1, 0.1, 0.1, 0.1)},
            {"sphere": -0.1},
            {"capsule": (0.1, -0.2)},
            {"sphere": "wide"},
            {"bocks": (0.1, 0.1, 0.1)},
            {"box": (0.1, 0.1, 0.1), "pos": (0, 0)},
            {"box": (0.1, 0.1, 0.1), "quat": (0, 0, 0, 0)},
            {"box": (0.1, 0.1, float("inf"))},
            "box",
        ],
    )
    def test_bad_geom_is_an_error_that_names_it(self, geom):
        with pytest.raises(ValueError, match=r"crate: geoms\[1\]"):
            scene_with(ObjectConfig("crate", [BOX, geom]))


class TestMeshes:
    @pytest.fixture
    def egg(self, tmp_path):
        """A 0.1 m ball with its centre at (0.3, 0.1, 0.2)."""
        mesh = trimesh.creation.icosphere(subdivisions=2, radius=0.1)
        mesh.apply_translation([0.3, 0.1, 0.2])
        mesh.export(tmp_path / "egg.obj")
        return str(tmp_path / "egg.obj")

    @pytest.mark.parametrize(
        ("scale", "low", "high"),
        [
            (1.0, (0.2, 0.0, 0.1), (0.4, 0.2, 0.3)),
            (2.0, (0.4, 0.0, 0.2), (0.8, 0.4, 0.6)),
            ((1.0, 2.0, 3.0), (0.2, 0.0, 0.3), (0.4, 0.4, 0.9)),
        ],
    )
    def test_bounds_and_mass(self, egg, scale, low, high):
        scene = scene_with(ObjectConfig("egg", [{"mesh": egg, "scale": scale}], mass=2.5))
        data = mujoco.MjData(scene.model)
        mujoco.mj_kinematics(scene.model, data)
        points = vertices(scene.model, data, scene.object_geoms[0])
        np.testing.assert_allclose(points.min(0), low, atol=1e-6)
        np.testing.assert_allclose(points.max(0), high, atol=1e-6)
        assert scene.model.body_mass[scene.object_body] == pytest.approx(2.5)

    def test_centroid_stays_where_the_file_has_it(self, egg):
        # turned a quarter about z, then shifted: (0.3, 0.1) -> (-0.1, 0.3) -> (0.9, 0.3)
        scene = scene_with(ObjectConfig("egg", [{"mesh": egg, "quat": QUARTER_Z, "pos": (1.0, 0.0, 0.0)}]))
        np.testing.assert_allclose(scene.model.body_ipos[scene.object_body], [0.9, 0.3, 0.2], atol=1e-6)

    def test_open_surface_weighs_what_the_config_says(self, tmp_path):
        corner = trimesh.Trimesh(np.vstack([np.zeros(3), np.eye(3)]), [[0, 1, 2], [0, 1, 3]], process=False)
        corner.export(tmp_path / "corner.obj")
        scene = scene_with(ObjectConfig("corner", [{"mesh": str(tmp_path / "corner.obj")}], mass=2.5))
        assert scene.model.body_mass[scene.object_body] == pytest.approx(2.5)

    def test_inside_out_surface_weighs_what_the_config_says(self, tmp_path):
        ball = trimesh.creation.icosphere(subdivisions=2, radius=0.1)
        ball.invert()
        ball.export(tmp_path / "ball.obj")
        geoms = [{"mesh": str(tmp_path / "ball.obj")}, {"box": (0.1, 0.1, 0.1), "pos": (1, 0, 0)}]
        scene = scene_with(ObjectConfig("pair", geoms, mass=2.5))
        assert scene.model.body_mass[scene.object_body] == pytest.approx(2.5)
        assert 0.5 < scene.model.body_ipos[scene.object_body][0] < 0.8  # the ball has a third of the volume

    def test_missing_file_is_an_error(self):
        with pytest.raises(FileNotFoundError, match=r"no file nowhere\.obj"):
            scene_with(ObjectConfig("crate", [{"mesh": "nowhere.obj"}]))

    @pytest.mark.parametrize(("torsional_friction", "spins"), [(0.0, True), (0.05, False)])
    def test_torsional_friction_stops_a_spin(self, torsional_friction, spins):
        """A ball touches the floor in one point: sliding friction does not brake its spin, a contact patch does."""
        ball = ObjectConfig("ball", [{"sphere": 0.1}], torsional_friction=torsional_friction)
        scene = scene_with(ball, placements={"ball": ((2.0, 0.0, 0.1), UPRIGHT)})
        data = mujoco.MjData(scene.model)
        data.qpos[:] = scene.default_qpos
        spin = scene.object_free_dof + 5
        data.qvel[spin] = 10.0
        for _ in range(200):
            mujoco.mj_step(scene.model, data)
        assert (data.qvel[spin] > 9.0) == spins
        assert spins or abs(data.qvel[spin]) < 1.0

    @pytest.mark.parametrize(("share", "slides"), [(0.8, False), (1.2, True)])
    def test_floor_leaves_friction_to_the_object(self, share, slides):
        """Coulomb: a box of 2 kg and friction 0.4 resists up to 0.4 * 2 * 9.81 N."""
        crate = ObjectConfig("crate", [{"box": (0.1, 0.1, 0.05)}], mass=2.0, friction=0.4)
        scene = scene_with(crate, placements={"crate": ((2.0, 0.0, 0.05), UPRIGHT)})
        data = mujoco.MjData(scene.model)
        data.qpos[:] = scene.default_qpos
        start = data.qpos[scene.object_free_qpos]
        data.xfrc_applied[scene.model.body("crate").id, 0] = share * 0.4 * 2.0 * 9.81
        for _ in range(100):
            mujoco.mj_step(scene.model, data)
        assert (data.qpos[scene.object_free_qpos] - start > 0.02) == slides

    def test_flat_mesh_is_an_error(self, tmp_path):
        square = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], [[0, 1, 2], [1, 3, 2]], process=False)
        square.export(tmp_path / "square.obj")
        with pytest.raises(ValueError, match=r"square.obj: encloses no volume"):
            scene_with(ObjectConfig("crate", [{"mesh": str(tmp_path / "square.obj")}]))

    @pytest.mark.parametrize(
        ("name", "content", "message"),
        [
            ("points.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\n", "holds no faces"),
            ("empty.stl", b"", "no faces|cannot be read as a mesh"),
            ("noise.glb", bytes(range(256)), "cannot be read as a mesh"),
            ("index.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "cannot be read as a mesh"),
            ("nan.obj", b"v 0 0 0\nv 1 0 nan\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n", "not finite"),
            ("pointer.obj", b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n", "git lfs pull"),
            ("thing.urdf", b"<robot/>", "urdf files hold no mesh that is read here; obj, stl, "),
            ("thing.xml", b"<mujoco/>", "xml files hold no mesh"),
            ("thing.usd", b"PXR-USDC", "usd files hold no mesh"),
            (
                "tiny.obj",
                b"v 0 0 0\nv 1e-5 0 0\nv 0 1e-5 0\nv 0 0 1e-5\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n",
                "no volume",
            ),
        ],
    )
    def test_what_is_no_mesh_is_an_error_that_names_the_file(self, tmp_path, name, content, message):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(ValueError, match=f"{name}: .*({message})"):
            load_mesh(str(tmp_path / name))

    @pytest.mark.parametrize("scale", [0.0, -1.0, float("nan"), (1.0, 2.0), "big"])
    def test_bad_scale_is_an_error(self, egg, scale):
        with pytest.raises(ValueError, match="scale: one positive figure or three"):
            load_mesh(str(egg), scale)

    @pytest.mark.parametrize("kind", ["obj", "stl", "ply", "off", "glb"])
    def test_formats(self, tmp_path, kind):
        trimesh.creation.box((0.2, 0.3, 0.4)).export(tmp_path / f"box.{kind}")
        assert load_mesh(str(tmp_path / f"box.{kind}"), (1, 1, 2)).volume == pytest.approx(2 * 0.024, rel=1e-5)

    def test_a_changed_file_is_read_again(self, tmp_path):
        path = tmp_path / "box.obj"
        for size in (0.2, 0.3):
            trimesh.creation.box((size, size, size)).export(path)
            os.utime(path, (1, size * 1e6))
            assert load_mesh(str(path)).volume == pytest.approx(size**3)


class TestScene:
    def test_control_period(self):
        assert SimConfig(timestep=0.004, decimation=5).control_dt == pytest.approx(0.02)

    def test_friction_stiffness(self):
        assert build_scene(RobotConfig(), SimConfig(cone="elliptic", impratio=10.0)).model.opt.impratio == 10.0

    @pytest.mark.parametrize("field", ["integrator", "cone"])
    def test_unknown_option_is_an_error(self, field):
        with pytest.raises(ValueError, match=rf"sim.{field}: .*'magic'"):
            build_scene(RobotConfig(), SimConfig(**{field: "magic"}))

    def test_scenery_stands_at_the_reference_or_at_its_pos(self):
        scenery = [SceneryConfig("table", [BOX], pos=(9, 9, 9)), SceneryConfig("shelf", [BOX], pos=(0, 2, 0.5))]
        model = scene_with(scenery=scenery, placements={"table": ((1, 2, 3), UPRIGHT)}).model
        np.testing.assert_allclose(model.body("table").pos, [1, 2, 3])
        np.testing.assert_allclose(model.body("shelf").pos, [0, 2, 0.5])
        assert model.body("table").dofnum[0] == 0

    def test_scenery_without_a_place_is_an_error(self):
        with pytest.raises(ValueError, match=r"scenery 'table': .*give it a pos"):
            scene_with(scenery=[SceneryConfig("table", [BOX])])

    def test_effector_must_be_a_robot_body(self):
        with pytest.raises(ValueError, match="effectors: robot has no body 'left_claw'"):
            scene_with(ObjectConfig("crate", [BOX]), effectors=[Effector("left_claw")])

    def test_effector_needs_an_object(self):
        with pytest.raises(ValueError, match="no object to touch"):
            scene_with(effectors=[Effector("left_wrist_yaw_link")])

    def test_effector_sensor_reads_contact_with_the_object_only(self, robot_scene, pose):
        hand = pose(robot_scene, height=2.0).xpos[robot_scene.model.body("left_wrist_yaw_link").id]
        target = ObjectConfig("block", [{"box": (0.1, 0.1, 0.02)}], fixed_base=True)
        table = SceneryConfig("table", [{"box": (0.1, 0.1, 0.02)}])
        below = np.array([0.1, 0.0, -0.05])
        effectors = [Effector("left_wrist_yaw_link"), Effector("right_wrist_yaw_link")]
        scene = scene_with(
            target,
            scenery=[table],
            effectors=effectors,
            placements={"block": (hand + below, UPRIGHT), "table": (hand * [1, -1, 1] + below, UPRIGHT)},
        )
        data = pose(scene, height=2.0)
        touched = {scene.model.body(scene.model.geom_bodyid[g]).name for c in data.contact for g in c.geom}
        assert {"block", "table", "left_wrist_yaw_link", "right_wrist_yaw_link"} <= touched
        left, right = np.linalg.norm(data.sensordata[scene.effector_sensors], axis=-1)
        assert left > 1.0
        assert right == 0.0

    def test_effector_sensor_reads_the_link_of_an_articulated_object(self, robot_scene, pose):
        hand = pose(robot_scene, height=2.0).xpos[robot_scene.model.body("left_wrist_yaw_link").id]
        hinge = HingeConfig("lid_joint", "lid", [{"box": (0.1, 0.1, 0.02), "pos": (0.1, 0.0, -0.05)}])
        chest = ObjectConfig("chest", [], hinge=hinge, fixed_base=True)
        scene = scene_with(chest, effectors=[Effector("left_wrist_yaw_link")], placements={"chest": (hand, UPRIGHT)})
        data = pose(scene, height=2.0)
        assert np.linalg.norm(data.sensordata[scene.effector_sensors[0]]) > 0.1

    def test_objects_rest_on_the_floor_and_on_scenery(self, pose):
        crate = ObjectConfig("crate", [{"box": (0.1, 0.1, 0.1)}])
        table = SceneryConfig("table", [{"box": (0.3, 0.3, 0.2)}])
        for place, height in (((3.0, 0.0, 0.12), 0.1), ((5.0, 0.0, 0.52), 0.5)):
            placements = {"crate": (place, UPRIGHT), "table": ((5.0, 0.0, 0.2), UPRIGHT)}
            scene = scene_with(crate, scenery=[table], placements=placements)
            data = pose(scene)
            for _ in range(100):
                mujoco.mj_step(scene.model, data)
            assert data.xpos[scene.object_body][2] == pytest.approx(height, abs=0.005)
