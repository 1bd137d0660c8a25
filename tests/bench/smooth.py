"""The smooth engine against MuJoCo, Pinocchio and Drake. `make bench NAME=smooth` (some minutes).

Ratios of CPU time in one run, the same stripped model for every engine, medians and quartiles of rounds in
turn. Names of parts as arguments run only those.
"""

import sys

from figures import main
from smooth_parts.agreement import agreement, lanes
from smooth_parts.price import orders, to_an_error
from smooth_parts.speed import drake, pinocchio, rollouts, two_cores
from smooth_parts.waiting import first_use

PARTS = {
    part.__name__: part
    for part in (
        agreement,
        lanes,
        orders,
        rollouts,
        two_cores,
        pinocchio,
        drake,
        to_an_error,
        first_use,
    )
}

if __name__ == "__main__":
    sys.exit(main("smooth", PARTS))
