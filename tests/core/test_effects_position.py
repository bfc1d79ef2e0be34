"""Each effect of the position channel against a closed form or a solution from elsewhere."""

import numpy as np
import pytest
from oracle import equilibrium as oracle
from scipy.optimize import brentq, root
from scipy.spatial.transform import Rotation
from test_equilibrium import SEVEN

from gapbridge.core.arm import arm_from_dh, builtin_arm, builtin_rows
from gapbridge.core.effects import CATALOGUE, Site, Term
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model

DH = {"ur10e": builtin_rows("ur10e")["dh"], "seven": SEVEN}
TOOL = np.array([0.03, -0.05, 0.18])
TURN = Rotation.from_euler("xyz", [0.4, -0.3, 0.8])
GRAVITY = np.array([0.4, -0.3, -9.8])
POSITION = [name for name, member in CATALOGUE.items() if "position" in member.channels]
POSES = 8
ARMS = pytest.mark.parametrize("name", DH)


def model_of(name, soft=0.0):
    tool = np.eye(4)
    tool[:3, :3], tool[:3, 3] = TURN.as_matrix(), TOOL
    model = Model(arm_from_dh(DH[name]), tool, gravity=GRAVITY)
    n = model.arm.n
    return model.with_compliance([soft] * n, [0.5 * soft] * n)


def scene(n, seed=1):
    rng = np.random.default_rng(seed)
    loads = Loads(rng.uniform(1, 6, POSES), rng.uniform(-0.1, 0.1, (POSES, 3)),
                  rng.normal(size=(POSES, 6)) * [30, 30, 30, 3, 3, 3],
                  rng.uniform(15, 45, (POSES, n)),
                  rng.integers(-1, 2, (POSES, n)).astype(float))  # fmt: skip
    return rng.uniform(-2, 2, (POSES, n)), loads


def case(name, q, loads, r, soft=0.0, changed=()):
    """Return row r for the independent solution."""
    n = len(DH[name])
    given = {
        "dh": DH[name], "q": q[r], "axial": np.full(n, soft), "radial": np.full(n, 0.5 * soft),
        "tool_position": TOOL, "tool_rotation": TURN,
        "payload": loads.payload_mass[r], "payload_cog": loads.payload_cog[r],
        "wrench": loads.wrench[r], "gravity": GRAVITY,
    } | dict(changed)  # fmt: skip
    return oracle.Case(**given)


def agree(name, terms, change, soft=0.0, atol=1e-10, seed=1):
    """Check the model with ``terms`` against the independent solution, changed row by row."""
    q, loads = scene(len(DH[name]), seed)
    model = model_of(name, soft)
    poses = model.with_terms(terms).predict(q, loads)
    plain = model.predict(q, loads)
    for r in range(POSES):
        position, rotation = oracle.solve(case(name, q, loads, r, soft, change(q, loads, r)))
        np.testing.assert_allclose(poses.position[r], position, atol=atol)
        np.testing.assert_allclose(poses.rotation[r], rotation, atol=atol)
    assert np.abs(poses.position - plain.position).max() > 1e-5


def term_of(name, arm, factor):
    member = CATALOGUE[name]
    sites = member.sites(arm)
    site = sites[min(1, len(sites) - 1)]
    if name == "transmission_error":
        site = Site(site.joint, 5.0)
    return Term(name, site, tuple(factor * p.scale for p in member.parameters(arm, site)))


@pytest.mark.parametrize("effect", POSITION)
@ARMS
def test_zero_values_change_nothing_and_usual_ones_something(effect, name):
    q, loads = scene(len(DH[name]))
    model = model_of(name, 1e-5)
    plain = model.predict(q, loads)
    none = model.with_terms([term_of(effect, model.arm, 0.0)]).predict(q, loads)
    np.testing.assert_array_equal(none.position, plain.position)
    np.testing.assert_array_equal(none.rotation, plain.rotation)
    some = model.with_terms([term_of(effect, model.arm, 1.0)]).predict(q, loads)
    moved = np.linalg.norm(some.position - plain.position, axis=1).max()
    # a usual size is one that shows: tens of micrometres to centimetres
    assert 1e-6 < moved < 5e-2


@ARMS
@pytest.mark.parametrize("joint", [1, 3, 6])
def test_a_joint_offset_is_added_to_the_encoder_angle(name, joint):
    value = 2e-3

    def turned(q, loads, r):
        return {"q": q[r] + value * np.eye(len(q[r]))[joint - 1]}

    agree(name, [Term("joint_offset", Site(joint), (value,))], turned)


@ARMS
@pytest.mark.parametrize("joint", [1, 2, 3, 4, 5])
def test_link_geometry_is_what_the_dh_row_has_more(name, joint):
    arm = arm_from_dh(DH[name])
    names = [p.name for p in CATALOGUE["link_geometry"].parameters(arm, Site(joint))]
    a, d, alpha = 1e-3, -2e-3, 3e-3
    values = (a, d, alpha) + (0.0,) * (len(names) - 3)
    rows = [dict(row) for row in DH[name]]
    for key, more in (("a", a), ("d", d), ("alpha", alpha)):
        rows[joint - 1][key] += more
    agree(name, [Term("link_geometry", Site(joint), values)], lambda q, loads, r: {"dh": rows})


def test_only_parallel_axes_have_a_second_twist():
    arm = arm_from_dh(DH["ur10e"])
    for joint, twisted in ((1, False), (2, True), (3, True), (4, False), (5, False)):
        names = [p.name for p in CATALOGUE["link_geometry"].parameters(arm, Site(joint))]
        assert ("beta" in names) is twisted


@pytest.mark.parametrize("joint", [2, 3])
def test_the_second_twist_turns_about_y_behind_the_link(joint):
    model, beta = model_of("ur10e"), 2e-3
    q, loads = scene(6)
    poses = model.with_terms([Term("link_geometry", Site(joint), (0.0, 0.0, 0.0, beta))]).predict(
        q, loads
    )
    for r in range(POSES):
        origins, turns, _, _, tcp = oracle.place(case("ur10e", q, loads, r), np.zeros((6, 3)))
        # all beyond turns about the link's y axis through the next joint's origin
        twist = Rotation.from_rotvec(beta * turns[joint - 1][:, 1])
        expected = origins[joint] + twist.apply(tcp - origins[joint])
        np.testing.assert_allclose(poses.position[r], expected, atol=1e-12)


CALIBRATED = {
    "delta_theta": [0.0, 0.35, -0.3501, 2e-4, 0.0, 0.0],
    "delta_a": [1e-5, 0.02, 0.03, 2e-5, 0.0, 0.0],
    "delta_d": [1e-5, 180.0, -179.9, -0.1, 0.0, 0.0],
    "delta_alpha": [2e-4, 1.3e-3, -1.2e-3, 1e-4, 0.0, 0.0],
}  # as factory calibrations are: axes of the drawing's parallel ones are 1 mrad apart


@pytest.mark.parametrize("joint", [2, 3])
@pytest.mark.parametrize("calibration", [CALIBRATED, {"delta_alpha": [0, 4e-6, -4e-6, 0, 0, 0]}])
def test_nearly_parallel_axes_have_the_twists_of_parallel_ones(joint, calibration):
    """Their common normal is metres away: a turn about it would throw the arm as far."""
    arm, drawing = builtin_arm("ur10e", calibration), builtin_arm("ur10e")
    member, site = CATALOGUE["link_geometry"], Site(joint)
    parameters = member.parameters(arm, site)
    assert [p.name for p in parameters] == ["a", "d", "alpha", "beta"]
    q, loads = scene(6)
    for k, parameter in enumerate(parameters):
        values = tuple(parameter.scale * (i == k) for i in range(4))
        moved = [
            Model(one).with_terms([Term("link_geometry", site, values)]).predict(q, loads).position
            - Model(one).predict(q, loads).position
            for one in (arm, drawing)
        ]
        turned = 0.4  # rad that the calibration's frames are turned by, and slightly displaced
        np.testing.assert_allclose(*(np.linalg.norm(m, axis=1) for m in moved), atol=2e-3 * turned)
        assert np.linalg.norm(moved[0], axis=1).max() < 3e-3


def test_a_term_without_its_second_twist_keeps_the_sense_of_a_dh_row():
    """Cells hold such terms of nearly parallel axes, found before these had a second twist."""
    rows = [dict(row) for row in DH["ur10e"]]
    rows[1]["alpha"] = 2e-3
    q, loads = scene(6)
    term = Term("link_geometry", Site(2), (1e-3, -2e-3, 3e-3))
    poses = Model(arm_from_dh(rows)).with_terms([term]).predict(q, loads)
    for key, more in (("a", 1e-3), ("d", -2e-3), ("alpha", 3e-3)):
        rows[1][key] += more
    changed = Model(arm_from_dh(rows)).predict(q, loads)
    np.testing.assert_allclose(poses.position, changed.position, atol=1e-10)
    member = CATALOGUE["link_geometry"]
    assert len(member.reported(Model(arm_from_dh(rows)).arm, term, None)) == 3


@ARMS
def test_the_tool_frame_moves_and_turns_the_tcp_in_flange_axes(name):
    shift, turn = np.array([1e-3, -2e-3, 3e-3]), np.array([0.01, 0.02, -0.03])
    agree(
        name, [Term("tool_frame", Site(), (*shift, *turn))],
        lambda q, loads, r: {"tool_position": TOOL + shift,
                             "tool_rotation": Rotation.from_rotvec(turn) * TURN},
    )  # fmt: skip


@ARMS
def test_a_transmission_error_is_amplitude_times_sine_of_order_angle_plus_phase(name):
    amplitude, phase, order = 4e-4, 0.7, 17.0
    values = (amplitude * np.cos(phase), amplitude * np.sin(phase))
    term = Term("transmission_error", Site(2, order), values)

    def waved(q, loads, r):
        angles = q[r].copy()
        angles[1] += amplitude * np.sin(order * q[r, 1] + phase)
        return {"q": angles}

    agree(name, [term], waved)
    shown = CATALOGUE["transmission_error"].reported(arm_from_dh(DH[name]), term, None)
    assert [t.value for t in shown] == pytest.approx([amplitude, phase])
    assert "order17" in shown[0].name


@ARMS
@pytest.mark.parametrize("effect", ["axial_compliance", "radial_compliance"])
def test_compliance_bends_its_joint_alone(name, effect):
    key, value = effect.split("_")[0], 2e-5

    def soft(q, loads, r):
        return {key: value * np.eye(len(DH[name]))[1]}

    agree(name, [Term(effect, Site(2), (value,))], soft)


@ARMS
def test_further_compliance_adds_to_the_models_own(name):
    def softer(q, loads, r):
        return {"axial": np.full(len(DH[name]), 1e-5) + 7e-6 * np.eye(len(DH[name]))[2]}

    agree(name, [Term("axial_compliance", Site(3), (7e-6,))], softer, soft=1e-5)


ROD = [{"a": 0.0, "alpha": np.pi / 2, "d": 0.0}, {"a": 1.2, "alpha": 0.0, "d": 0.0}]


@pytest.mark.parametrize("mass", [0.5, 5.0, 50.0])
def test_a_stiffening_joint_follows_its_curve(mass):
    c, knee, length = 1e-4, 80.0, 1.2
    term = Term("stiffness_nonlinearity", Site(2), (c, 1 / knee**2))
    model = Model(arm_from_dh(ROD), payload_mass=mass).with_terms([term])
    q = np.array([[0.3, 0.4]])

    def left(theta):
        M = -mass * 9.80665 * length * np.cos(0.4 + theta)
        return theta - c * M / np.sqrt(1 + (M / knee) ** 2)

    angle = 0.4 + brentq(left, -0.2, 0.2, xtol=1e-15)
    expected = length * np.array([np.cos(angle) * np.cos(0.3), np.cos(angle) * np.sin(0.3),
                                  np.sin(angle)])  # fmt: skip
    np.testing.assert_allclose(model.predict(q).position[0], expected, atol=1e-12)
    shown = CATALOGUE["stiffness_nonlinearity"].reported(model.arm, term, None)
    assert [t.value for t in shown] == pytest.approx([c, knee])


def test_a_flexible_link_is_a_cantilever_loaded_at_its_far_end():
    length, beyond, flexibility = 0.8, 0.3, 1e-6
    rows = [{"a": length, "alpha": 0.0, "d": 0.0}, {"a": beyond, "alpha": 0.0, "d": 0.0}]
    model = Model(arm_from_dh(rows), gravity=np.zeros(3))
    deflected = model.with_terms([Term("link_flexibility", Site(1), (flexibility,))])
    F, T = 20.0, -3.0
    for axis, sign in ((1, 1.0), (2, -1.0)):
        wrench = np.zeros((1, 6))
        wrench[0, axis], wrench[0, 3 + 3 - axis] = F, T
        # at the link's end: the force, and the moment of what is beyond
        M = F * beyond + sign * T
        shift = flexibility * (F * length**3 / 3 + M * length**2 / 2)
        slope = flexibility * (F * length**2 / 2 + M * length)
        moved = deflected.predict(np.zeros((1, 2)), Loads(wrench=wrench))
        tip = moved.position[0] - [length + beyond, 0, 0]
        assert tip[axis] == pytest.approx(shift + slope * beyond, rel=1e-4)
        assert moved.rotation[0, axis, 0] == pytest.approx(slope, rel=1e-4)


def test_a_flexible_link_neither_stretches_nor_twists():
    rows = [{"a": 0.8, "alpha": 0.0, "d": 0.0}, {"a": 0.3, "alpha": 0.0, "d": 0.0}]
    model = Model(arm_from_dh(rows), gravity=np.zeros(3))
    deflected = model.with_terms([Term("link_flexibility", Site(1), (1e-5,))])
    pull = np.array([[100.0, 0, 0, 5.0, 0, 0]])
    moved = deflected.predict(np.zeros((1, 2)), Loads(wrench=pull))
    np.testing.assert_allclose(moved.position[0], [1.1, 0, 0], atol=1e-14)
    np.testing.assert_allclose(moved.rotation[0], np.eye(3), atol=1e-14)


@ARMS
def test_a_soft_base_tilts_the_whole_arm_under_its_moment(name):
    value = np.array([2e-5, 1e-5])
    q, loads = scene(len(DH[name]))
    term = Term("base_compliance", Site(), tuple(value))
    poses = model_of(name).with_terms([term]).predict(q, loads)
    for r in range(POSES):
        here = case(name, q, loads, r)
        _, _, centres, (flange, point), tcp = oracle.place(here, np.zeros((len(q[r]), 3)))
        load = point + flange @ here.payload_cog

        def left(base_rotation, here=here, centres=centres, load=load, tcp=tcp):
            turn = Rotation.from_rotvec([*base_rotation, 0])
            M = here.wrench[3:] + np.cross(turn.apply(tcp), here.wrench[:3])
            M = M + np.cross(turn.apply(load), here.payload * GRAVITY)
            for centre, row in zip(centres, DH[name], strict=True):
                M = M + np.cross(turn.apply(centre), row["mass"] * GRAVITY)
            return 1e3 * (base_rotation - value * M[:2])

        turn = Rotation.from_rotvec([*root(left, np.zeros(2), tol=1e-14).x, 0])
        np.testing.assert_allclose(poses.position[r], turn.apply(tcp), atol=1e-10)
        np.testing.assert_allclose(
            poses.rotation[r], turn.as_matrix() @ flange @ TURN.as_matrix(), atol=1e-10
        )


@ARMS
def test_gravity_direction_turns_gravity_about_x_and_y_of_base(name):
    turn = Rotation.from_rotvec([0.05, -0.03, 0])
    agree(name, [Term("gravity_direction", Site(), (0.05, -0.03))],
          lambda q, loads, r: {"gravity": turn.apply(GRAVITY)}, soft=2e-5)  # fmt: skip


@ARMS
def test_a_payload_beyond_the_declared_acts_at_the_declared_centre(name):
    agree(name, [Term("payload", Site(), (1.5,))],
          lambda q, loads, r: {"payload": loads.payload_mass[r] + 1.5}, soft=2e-5)  # fmt: skip


@ARMS
def test_backlash_lags_half_the_clearance_behind_the_last_motion(name):
    def lagging(q, loads, r):
        return {"q": q[r] - 0.5 * 6e-4 * loads.approach[r, 2] * np.eye(len(q[r]))[2]}

    agree(name, [Term("backlash", Site(3), (6e-4,))], lagging)


@ARMS
def test_thermal_drift_lengthens_a_and_d_by_the_joints_warmth(name):
    def grown(q, loads, r):
        warm = 1 + 2e-5 * (loads.temperature[r] - 25.0)
        rows = [row | {"a": row["a"] * k, "d": row["d"] * k}
                for row, k in zip(DH[name], warm, strict=True)]  # fmt: skip
        return {"dh": rows}

    agree(name, [Term("thermal_drift", Site(), (2e-5,))], grown)


@pytest.mark.parametrize("effect", ["backlash", "thermal_drift"])
def test_what_the_rows_do_not_show_has_no_effect(effect):
    model = model_of("ur10e")
    q, _ = scene(6)
    shown = model.with_terms([term_of(effect, model.arm, 1.0)]).predict(q)
    np.testing.assert_array_equal(shown.position, model.predict(q).position)
