"""What decides an answer: the constants of search and judgement, and what set them.

Figures are of the blind benchmark (cases of one to four known effects, of known effects beside an
unknown one of comparable size, of an unknown one alone) unless a real log is named. The logs of
real arms that set a constant are series A of a UR10 and the grid of a Barrett WAM; the others only
checked it.
"""

from __future__ import annotations

# An accusation beside the unnamed functions that the residual asks for
SIGMAS = 6.0  # of its value; 4 gives 11 false of 72 unknown alone, 6 to 8 7, 12 loses weak ones
FURTHER = 0.3  # of what one number takes, for each further number of a cause: chance exceeds 9.0,
# 11.8 and 14.2 alike with 1, 2 and 3; with 1 steps of a target and centres of loads are lost
SIBLING = 3.0  # at further joints of an effect that stays at one: 7 of 218 true terms lost without
MAX_DRIFT = 1.5  # times, of its value: 2 gives one false more, 1.3 loses real friction
ALIKE = 0.1  # 1 sigma of a joint's delay about the median of all, in shares of it, at least: a
# UR5e's five joints lie within 0.15 of it, the sixth never moves
MAX_TAKEN = 0.3  # share of a number that directions of the unnamed functions may hold: with more,
# what is left of it is no estimate
SEVERAL_AT_A_TIME = 900  # rows of the sample space from which the weakest eighth goes at once,
HOPELESS = 0.6  # as far as its strength is below this: a matter of time, not of the answer
MAX_UNNAMED = 6  # unnamed functions asked for at a time: more span the short logs
# of a number's constant, how far it may go by a quantity: unknowns that an effect is the first
# order of go by 0.39 to 0.87; by quarters of its joint's range goes the UR10's line that helps in
# three later series by 0.23, one that worsens all three by 0.39
VARIES = 1 / 3
# An accusation by itself
OWN_SIGMAS = 3.0  # of at least one of its numbers: what an engineer calls a finding
NEGLIGIBLE = 1e-3  # of its parameters' usual sizes: the tail of a servo is a dead band of 5e-9 rad
STAND_IN_GAIN = 0.02  # lower end of a stand-in's held-out gain, in regions that its fit did not see
HEAVIEST = 3.0  # times the largest declared payload (or the rated one): a load is not off by more
# Geometry as a whole
# (sizes of machining, which a fit needs too: core/estimation/geometry.py)
TIMES_SET = tuple(2.0**k for k in range(6))  # times an angle of machining, of joints' zeros, which
# are set: an IRB 120's lengths are machined (1), its zeros 7 to 35 mrad off
FEW_LINKS = 3  # joints with a first moment, friction or zero singly, from which all are tried: four
# logs of a UR10e then agree on what is there, and one moves from 1.07 to 0.97 of base parameters;
# or with a flexibility: in 33 rows of a soft arm links were accused that do not bend
# of what is left in every part not fitted: the Motoman cube keeps 0.20 to 0.27, a UR5's grid 0.18
# to 0.21, unknown causes 0.42 at least in some part, nearly always all of the gap
CLOSED_SHARE = 1 / 3
# of what several accusations leave: an iiwa's tool and what bends keep 0.24 to 0.27 in all, 0.33 to
# 0.41 in the worst part (one of the two alone: 0.92 to 1.0); in 161 cases nothing else changes
CLOSED_IN_A_PART = 1 / 2
MIN_GEOMETRIC_CAUSES = 2  # geometric causes from which all links are tried as a whole
# A residual with structure
SURE_P = 0.002  # probability below which it is sure: chance says so of one clean log in 500
HINT_P = 0.05  # the same where the search needed an unnamed function or an accusation has fallen
OVER_STATED_NOISE = 1.5  # times the stated noise: beyond, more than noise is left
OVER_REPEAT_SCATTER = 1.6  # times the scatter of repeated poses
REPEATS_REFUTE = 30  # degrees of freedom from which repeats may say that more than noise is left
SAME_SHARE = 0.05  # held-out share within which two quantities say the same
USUAL_REPEATABILITY = 1.2e-4  # m, one coordinate: a worse repeatability than that is none
OVER_INSTRUMENT_SIGMA = 5.0  # times the instrument's sigma, for coarse instruments
# The noise floor
REPEATS_MEASURE = 10  # degrees of freedom from which repeats measure it: to a quarter of its size
RESIDUAL_MEASURES = 400  # samples from which the residual's own rms is the better estimate
# What a log shows
EXCITED = 3.0  # whitened length of an effect of usual size: an engineer's three sigmas
MIN_FREEDOM = 6  # readings beyond the unknowns of the frame, for a channel to be diagnosed
MIN_CONDITIONS = 4  # different poses, or stretches of a recording, for the same
MIN_FREEDOM_OF_SESSION = 3  # readings beyond the unknowns of a session's own frame
MIN_APPROACHES = 4  # rows that come from either side, for a quantity to be a joint's last motion
MIN_TORQUE_CHANGE = 1e-3  # share of the largest held torque by which one has to change to count
STEPPED_SHARE = 0.5  # distinct values over samples below which a signal comes in steps
MIN_CYCLES = 1.5  # of a periodic line over the joint's range
MIN_ROWS_BESIDE_STEP = 3  # on either side of a moment at which something steps
DECISIVE = 1.0  # times the noise: a proposed measurement that differs by less decides nothing
MAIN_SHARE = 0.5  # of the gap on unseen poses: where a fit of flexibilities leaves more, they are
# not the main thing
# Ties
TIE_SCORE = 7.0  # score within which another explanation counts as equally good
CURVATURE_GAIN = 10.8  # in -2 log likelihood, of a nonlinear stiffness over a linear one
SAME_SPAN = 1e-4  # of a cause's squares left by another that does all it does: rounding
# The search: what a hypothesis costs. These hold together; the blind tables of docs/evidence.md
# are what supports them as a whole, none was measured by itself
ACCUSATION_PENALTY = 6.0  # score that every accusation pays: keeps clean logs clean
SMOOTH_PENALTY = 18.0  # the same of an unnamed function beyond a named cause
FAMILY_PENALTY = 4.0  # score that one kind of effect at two places may cost beyond two kinds
NO_REVERSAL_PENALTY = 3.0  # of play in a log without reversals: it stands behind the offset
ANY_CONSTANT_PENALTY = 1e-3  # of a sensor's constant: decides exact ties, which rounding did
MAX_LINES = 4  # periodic lines a joint may have: more are the Fourier series of something else
MIN_ORDERS_APART = 0.75  # cycles a turn between two lines of a joint
MIN_PERIODS = 0.75  # of a line, beside something unknown: a sine's less than two extremes are any
# curve's. False lines showed 0.26 to 0.54, true ones beside an unknown 0.89 and more
MIN_DELAYS = 3  # known ones: below, nobody knows which joint is the odd one
NO_WORTH = 1e-4  # worth of a value below which it goes at once: a thirtieth of its sigma
MAX_SMOOTH_TERMS = 2  # unnamed functions of a set: more add nothing
LARGE_SAMPLE = 450  # rows of the sample space from which many causes are looked for, one by one
# Sizes of an arm, by what Effect.parameters calls usual
MAX_TIMES_USUAL = 200.0  # times the usual size: beyond, a fit is no explanation
MAX_SOFTENING = 6000.0  # times the usual softening of a stiffness curve
TOO_LARGE_SIGMAS = 3.0  # by which a linear value has to be beyond those sizes
OUT_OF_BOUNDS_SIGMAS = 2.5  # by which it has to be below its lower bound
PRIOR_REACH = 100.0  # times the usual size: how far the data may take a number against nothing
UNDETERMINED = 30.0  # times the usual size: with a wider spread nothing is known of a number
LOOSE_PRIOR = 5.0  # times the usual size: 1 sigma of what else may be there (outliers, steps)
# Unnamed functions against what they stand beside
DEGENERATE = 1e-5  # eigenvalue of unit columns below which a direction is the unnamed ones
HELD_WHOLLY = 0.98  # share of an effect's column in an unnamed rival's span that makes it a part,
# and of what an unnamed load does in the span of a load found
MOSTLY = 0.9  # share of what the rival takes that has to be this part: a pull nearly down, a weight
# Noise and outliers
UNRESOLVED = 1e-7  # m, N, rad, Nm: no instrument resolves what is left below (26 bits: 9e-8 rad);
# a servo that rests 4e-9 rad from its target was an unexplained gap
KNOWN_SHARE = 0.7  # of a stated repeatability, which is an average: less is not assumed
NOT_WHITE = 0.001  # probability below which the residual of a recording is not white
EXCESS = 0.5  # times the floor: a correlated part smaller than that changes no answer
OUTLIER_SHARE = 0.1  # of the samples: more outliers than that are structure, not bad luck
MOST_OUTLIERS = 1 / 3  # of the poses, excluded nevertheless: ten bad rows of 33, fitted, stood as
# causes that are not there; their median shows the noise of the others up to there
UNPREDICTED_SHARE = 0.5  # share of an outlier that may be left where something else explains it
# Several sessions
CHANCE = 0.001  # probability below which the values of sessions differ by more than chance
MATERIAL_SHARE = 0.2  # share of a cause's size: sessions that differ by less are alike for a model
# Mistakes of frames and signs in a log
NOT_THE_ARM = 0.02  # m and rad: more than any arm errs
MISTAKE_LEAVES = 0.1  # share of the distance that may be left for a mistake to be named
CLEARLY_BETTER = 0.8  # of what the best mistake before leaves, for another to be named instead
SIGN_LEAVES = 0.5  # of what the pull leaves as the log has it, for another sign to be named
