"""What decides an accusation: every constant of the judgement, and what set it.

Figures are of the blind benchmark (cases of one to four known effects, of known effects beside an
unknown one of comparable size, of an unknown one alone) unless a real log is named. The logs of
real arms that set a constant are series A of a UR10 and the grid of a Barrett WAM; the others only
checked it.
"""

from __future__ import annotations

# An accusation beside the unnamed functions that the residual asks for
SIGMAS = (
    6.0  # of its value; 4 gives 11 false of 72 unknown alone, 6 to 8 give 7, 12 loses weak ones
)
SIBLING = 3.0  # at further joints of an effect that stays at one: 7 of 218 true terms lost without
DRIFT = 1.5  # times: how far its value may move; 2 gives one false more, 1.3 loses real friction
UNKNOWNS = 6  # unnamed functions asked for at a time: more span the short logs
# An accusation by itself
OWN_SIGMAS = 3.0  # of at least one of its numbers: what an engineer calls a finding
MINUTE = 1e-3  # of its parameters' usual sizes: the tail of a servo is a dead band of 5e-9 rad
GAIN = 0.0  # lower end of the held-out gain of a cause
STAND_IN_GAIN = 0.02  # the same of a stand-in, in regions that its fit did not see
HEAVIEST = 3.0  # times the largest declared payload (or the rated one): a load is not off by more
# Geometry as a whole
LENGTH, ANGLE = 5e-4, 1e-3  # m, rad: 1 sigma of machining and assembly
SHARES = (0.2, 1.0)  # of them: a factory calibration leaves a fifth, a kit arm all of it
CLOSED = 1 / 3  # of the gap in every part not fitted: the Motoman cube keeps 0.20 to 0.29, unknown
# causes 0.42 at least in some part, nearly always all of the gap
GEOMETRIC = 2  # geometric causes from which all links are tried as a whole
# A residual with structure
SURE = 0.002  # probability below which it is sure, times one more than the causes beside it
HINT = 0.05  # the same where the search needed an unnamed function or an accusation has fallen
STATED = 1.5  # times the stated noise: beyond, more than noise is left
REPEATED = 1.6  # times the scatter of repeated poses
ENOUGH_REPEATS = 30  # degrees of freedom from which repeats are a measure of the noise
USUAL = 1.2e-4  # m, one coordinate: a worse repeatability than that is none
INSTRUMENTS = 5.0  # times the instrument's sigma, for coarse instruments
# Ties
TIE = 7.0  # score within which another explanation counts as equally good
BENT = 10.8  # gain in -2 log likelihood of a bent stiffness curve over a straight one
