"""Another simulator's prediction, row by row, in place of the model's own.

The user's simulator gives the nominal prediction; the model only gives its change by an effect.
The simulator's values are added to the log as further columns.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.diagnosis.observation import NotObservable, Observation
from gapbridge.core.effects import Term
from gapbridge.core.errors import LogError
from gapbridge.core.log.alignment import aligned
from gapbridge.core.log.log import Log
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model
from gapbridge.core.motion import motion_of, with_motion, without_turns
from gapbridge.core.rotation import rotation_matrix, rotation_vector

Observe = Callable[[Model, Log, Metrology], Observation | NotObservable]
COLUMN_OF_CHANNEL = {
    "position": "measured_position",
    "wrench": "ft_raw_wrench",
    "tracking": "actual_q",
    "torque": "actual_current_as_torque",
}
ROTATION = "measured_rotation"
PREFIX = "simulated "


def joined(log: Log, simulated: Log) -> Log:
    """Return the log with the simulator's values as further columns.

    Raises LogError where a row has no counterpart or one of another pose, or the simulator's has
    nothing to compare.
    """
    simulated = aligned(without_turns(simulated), log)
    predictions = {
        PREFIX + name: simulated.require(name)
        for name in (*COLUMN_OF_CHANNEL.values(), ROTATION)
        if simulated.has(name)
    }
    if not predictions:
        wanted = ", ".join(f"{name}_0.." for name in COLUMN_OF_CHANNEL.values())
        raise LogError(f"{simulated.path}: columns: found no prediction, expected one of {wanted}")
    return replace(log, columns={**log.columns, **predictions})


def predicted_by(channel: str, observe: Observe) -> Observe:
    """Return an observer with the simulator's prediction; a channel it lacks is not observable.

    Rotations are compared only if the simulator has them.
    """

    def simulated(model: Model, log: Log, metrology: Metrology) -> Observation | NotObservable:
        values = log.get(PREFIX + COLUMN_OF_CHANNEL[channel])
        observation = observe(model, _behind(log, channel, values), metrology)
        if isinstance(observation, NotObservable):
            return observation
        if values is None:
            needs = f"{COLUMN_OF_CHANNEL[channel]} (in the simulator's log)"
            return NotObservable(channel, (needs,))
        return _with_prediction(observation, values, log.get(PREFIX + ROTATION))

    return simulated


def _behind(log: Log, channel: str, values: Array | None) -> Log:
    """Return the log of a tracking channel with the simulator's encoders as its command.

    That of a position channel is without rotations that the simulator lacks.
    A delay or lag to be found is then in series with the simulated servo's own. The motion remains
    that of the log, because a block of a long log cannot derive it from its own rows.
    """
    if channel == "position" and not log.has(PREFIX + ROTATION):
        return replace(log, columns={n: c for n, c in log.columns.items() if n != ROTATION})
    if channel != "tracking" or values is None or not log.has("target_q"):
        return log
    motion = motion_of(log)
    behind = replace(log, columns={**log.columns, "target_q": values})
    return with_motion(behind, replace(motion, target_q=values[motion.rows]))


def _with_prediction(
    observation: Observation, values: Array, rotation: Array | None, terms: Sequence[Term] = ()
) -> Observation:
    """Return the observation with the simulator's ``values`` and, of poses, ``rotation`` (N, 3).

    ``terms`` are those that the observation's columns were made at.
    """
    channel_rows, rebase, subset = observation.predict, observation.rebase, observation.subset
    nominal = channel_rows(())
    base = nominal.copy()
    part = values[observation.rows]
    base[:, : part.shape[1]] = part
    if observation.channel == "position" and base.shape[1] > 3:
        assert rotation is not None and observation.tool_axes is not None
        # rotations are relative to the measured one: known from the model's TCP beside it
        to_measured = rotation_matrix(channel_rows(terms)[:, 3:])
        from_model = rotation_matrix(rotation[observation.rows]) @ np.swapaxes(
            observation.tool_axes, 1, 2
        )
        base[:, 3:] = rotation_vector(from_model @ to_measured)

    def predict(terms: Sequence[Term]) -> Array:
        return np.asarray(base + (channel_rows(terms) - nominal)) if terms else base

    moved = (
        None
        if rebase is None
        else lambda step, terms: _with_prediction(rebase(step, terms), values, rotation, terms)
    )
    thinned = (
        None if subset is None else lambda take: _with_prediction(subset(take), values, rotation)
    )
    return replace(observation, predict=predict, rebase=moved, subset=thinned, uncertain=None)
