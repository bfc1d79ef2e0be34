"""Memory layout of a block of rows: LANES rows in structure-of-arrays order.

A slot holds one quantity of all lanes. Each joint has a record of slots in one workspace, with
strides known at compile time; quantities of the whole row are in a second workspace.
"""

from __future__ import annotations

import numpy as np

from gapbridge.core.kernels.reference import INNER

FAST = {**INNER, "fastmath": {"contract", "nsz"}}  # nothing that reorders sums
SUMS = {**INNER, "fastmath": {"contract", "nsz", "reassoc"}}  # sums over lanes, in any order
LANES = 64
U = np.uintp  # unsigned index: no check for negative values

# slots of one record: record 0 is the base, 1..n the joints, n+1 the flange
ROTATION, ORIGIN, MOMENT, BEND, AXIS, TOTAL = 0, 9, 12, 15, 18, 21
ANGLE, LINK_SCALE, SINE, COSINE = 27, 28, 29, 30
RECORD = 31
# slots of the second workspace
MASS, COG, WRENCH, TCP, TCP_ROTATION, CHANGE = 0, 1, 4, 10, 13, 22
ROW = 23
MAX_ROUNDS = 40  # beyond, a row is near buckling, and solved by core.kernels.reference
MAX_BEND_SQUARE = 0.09  # rad2: squared bending up to which the series are exact to rounding
MAX_ANGLE = 1e4  # rad: beyond, the reduction to a quarter turn loses digits
