"""How far core is from independent solutions: largest differences over random cases.

Equilibrium: all bend vectors as one system of equations, solved by MINPACK (tests/oracle), over
random poses, loads and compliances of 6 and 7 joints. Frames, Jacobians and joint moments:
Pinocchio.
"""

from __future__ import annotations

import argparse

import numpy as np

from benchmarks.evidence.arms import dh_rows
from gapbridge.core.arm import arm_from_dh
from gapbridge.core.compensation import correct
from gapbridge.core.kernels.single import TOLERANCE
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model
from tests.oracle import equilibrium, rigid

# arm -> largest payload (kg), a usual flexibility (rad/Nm)
ARMS = {"ur3e": (3.0, 2e-5), "ur10e": (12.5, 4e-6), "seven": (14.0, 1e-5)}


def model_of(case: equilibrium.Case) -> tuple[Model, Loads]:
    tool = np.eye(4)
    tool[:3, :3], tool[:3, 3] = case.tool_rotation.as_matrix(), case.tool_position
    model = Model(arm_from_dh(case.dh), tool, gravity=case.gravity)
    return model, Loads(np.array([case.payload]), case.payload_cog[None], case.wrench[None])


def bent_arms(count: int, rng: np.random.Generator) -> None:
    """Print how predictions compare with the independent equilibrium and with the linear form."""
    shift, turn, moved, ratios, left = [], [], [], [], []
    for k in range(count):
        name = list(ARMS)[k % len(ARMS)]
        payload, softness = ARMS[name]
        dh = dh_rows(name)
        softness *= 10 ** rng.uniform(-1, 0.7)
        case = equilibrium.random_case(rng, dh, payload, softness)
        model, loads = model_of(case)
        rigid_arm = model.predict(case.q[None], loads).position[0]
        deflected = model.with_compliance(case.axial, case.radial)
        pose = deflected.predict(case.q[None], loads)
        position, rotation = equilibrium.solve(case)
        shift.append(np.linalg.norm(pose.position[0] - position))
        turn.append(np.abs(pose.rotation[0] - rotation).max())
        moved.append(np.linalg.norm(position - rigid_arm))
        A = model.linear_form(case.q[None], loads).regressor[0, :3]
        flexibility = np.concatenate([case.axial, case.radial])
        half = model.with_compliance(case.axial / 2, case.radial / 2)
        halved = half.predict(case.q[None], loads).position[0]
        errors = [
            np.linalg.norm(exact - rigid_arm - share * A @ flexibility)
            for exact, share in ((pose.position[0], 1.0), (halved, 0.5))
        ]
        ratios.append(errors[0] / errors[1])
        left.append(correct(deflected, case.q, loads).residual[0])
    percent = np.percentile(ratios, [5, 50, 95])
    reached = np.array(left) < TOLERANCE
    print(f"equilibrium, {count} cases ({', '.join(ARMS)}; deflections up to {max(moved):.3f} m):")
    print(f"  largest difference {max(shift):.1e} m in position, {max(turn):.1e} in rotation")
    print("  linear form's error at full over half compliance: "
          f"{percent[1]:.3f} (5 to 95 %: {percent[0]:.3f} to {percent[2]:.3f})")  # fmt: skip
    print(f"  compensation reaches the wanted pose to {TOLERANCE:g} m in {reached.mean():.1%}")


def rigid_arms(count: int, rng: np.random.Generator) -> None:
    """Print how frames, Jacobians and moments compare with Pinocchio's."""
    frames, jacobians, moments = [], [], []
    for name in ARMS:
        oracle = rigid.from_dh(dh_rows(name))
        for _ in range(count):
            case = equilibrium.random_case(rng, dh_rows(name), ARMS[name][0], 0.0)
            model, loads = model_of(case)
            pose, form = model.rigid_pose(case.q[None]), model.linear_form(case.q[None], loads)
            flange = rigid.flange_pose(oracle, case.q)
            frames.append(np.abs(pose.position[0] - flange.act(case.tool_position)).max())
            J = rigid.tool_jacobian(oracle, case.q, case.tool_position)
            jacobians.append(np.abs(form.jacobian[0] - J).max())
            M = rigid.joint_moments(oracle, case.q, case.gravity, case.tool_position, case.wrench,
                                    case.payload, case.payload_cog)  # fmt: skip
            moments.append(np.abs(form.moment[0] - M).max())
    print(
        f"Pinocchio, {len(frames)} cases: largest difference {max(frames):.1e} m in position, "
        f"{max(jacobians):.1e} in the Jacobian, {max(moments):.1e} Nm in the joint moments"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    rng = np.random.default_rng(options.seed)
    bent_arms(options.cases, rng)
    rigid_arms(options.cases // 10, rng)


if __name__ == "__main__":
    main()
