"""How a block of rows lies in memory: LANES rows side by side, slot by slot.

A slot holds one quantity of all lanes. Each joint has a record of slots in one workspace, all of
them at distances that are known when the loops are compiled; what belongs to the whole row lies in
a second workspace.
"""

from __future__ import annotations

import numpy as np

from gapbridge.core.kernels.reference import INNER

FAST = {**INNER, "fastmath": {"contract", "nsz"}}  # nothing that reorders sums
SUMS = {**INNER, "fastmath": {"contract", "nsz", "reassoc"}}  # sums over lanes, in any order
LANES = 64
U = np.uintp  # an index that is no signed number needs no look whether it counts from the end

# slots of one record: record 0 is the base, 1..n the joints, n+1 the flange
ROTATION, ORIGIN, MOMENT, BEND, AXIS, TOTAL = 0, 9, 12, 15, 18, 21
ANGLE, LINK_SCALE, SINE, COSINE = 27, 28, 29, 30
RECORD = 31
# slots of the block beside the records
MASS, COG, WRENCH, TCP, TCP_ROTATION, CHANGE = 0, 1, 4, 10, 13, 22
ROW = 23
MOST_ROUNDS = 40  # what takes longer is near to buckling, and left to core.kernels.reference
STEEPEST = 0.09  # rad2: squared bending up to which the series below are exact to rounding
FARTHEST = 1e4  # rad: beyond, the reduction to a quarter turn loses digits
