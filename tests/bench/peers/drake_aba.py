"""Drake's forward dynamics on states from a file; run in an environment of its own.

python drake_aba.py MODEL.xml STATES.npz RESULT.npz

Drake's package carries no C++ headers, so it is called from Python. The price of that is measured by the
same two calls with a second context whose answer is still in its cache, and taken off.
"""

import logging
import sys
import time

import numpy as np
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant

LEAST, ROUNDS = 0.05, 5  # seconds of a round, rounds


def seconds(plant, context, states, asked, repeats):
    """CPU time of setting every state and asking for the derivatives in the context `asked`, per state."""
    place, derivatives = plant.SetPositionsAndVelocities, plant.EvalTimeDerivatives
    begin = time.process_time()
    for _ in range(repeats):
        for x in states:
            place(context, x)
            derivatives(asked)
    return (time.process_time() - begin) / (repeats * len(states))


def main():
    path, given, result = sys.argv[1:]
    logging.getLogger("drake").setLevel(logging.ERROR)
    data = np.load(given)
    plant = MultibodyPlant(0.0)  # continuous: accelerations by the articulated-body algorithm
    Parser(plant).AddModels(path)
    plant.Finalize()
    if (plant.num_positions(), plant.num_velocities()) != (data["q"].shape[1], data["v"].shape[1]):
        sys.exit(f"Drake's MJCF parser makes {plant.num_positions()} positions of {data['q'].shape[1]}")
    context, still = plant.CreateDefaultContext(), plant.CreateDefaultContext()
    force = plant.get_applied_generalized_force_input_port()
    states, a = list(np.concatenate([data["q"], data["v"]], axis=1)), []
    for x, tau in zip(states, data["tau"], strict=True):
        plant.SetPositionsAndVelocities(context, x)
        force.FixValue(context, tau)
        a.append(plant.EvalTimeDerivatives(context).get_generalized_velocity().CopyToVector())
    repeats = int(np.ceil(LEAST / (seconds(plant, context, states, context, 1) * len(states))))
    rounds = [[seconds(plant, context, states, c, repeats) for c in (context, still)] for _ in range(ROUNDS)]
    whole, calls = np.array(rounds).T
    np.savez(result, a=a, seconds=np.median(whole - calls), call_seconds=np.median(calls))


main()
