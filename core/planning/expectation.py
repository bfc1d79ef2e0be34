"""What a session will determine, before anyone moves: expected deviations of parameters and TCP."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.calibration.observables.nuisance import Nuisance
from gapbridge.core.calibration.observables.observable import Observable
from gapbridge.core.calibration.parameters import Parameters
from gapbridge.core.calibration.plan import Expectation
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.loads import Loads
from gapbridge.core.planning.information import Reference, blocks, expectation_of

Array = NDArray[np.float64]


def expectation(
    parameters: Parameters,
    observable: Observable,
    readings: Readings,
    nuisance: Nuisance,
    sigma: float,
    reference: tuple[Array, Loads],
) -> Expectation:
    """Return what the fitted readings (held-out ones are left out) determine of each parameter.

    ``sigma`` is 1 sigma of one coordinate of a reading (m), instrument and arm together.
    ``reference`` are the poses (M, n) and loads over which the predicted TCP is judged. Values are
    not looked at. Where everything is known no better than its weak prior, std is inf.
    """
    fitted = readings[np.flatnonzero(~readings.held_out)]
    begin = parameters.model(parameters.begin)
    fitted = replace(fitted, value=observable.predict(begin, fitted, nuisance))
    rows = blocks(parameters, observable, fitted, nuisance, sigma)
    return expectation_of(parameters, rows, Reference.of(parameters, *reference))
