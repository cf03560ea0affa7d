"""Networks with random weights, for tests."""

import numpy as np

from diffdrive_mpc_extras.networks.network import Architecture, Network
from diffdrive_mpc_extras.networks.network_model import network_model

DT = 0.0202


def random_network(seed=0, scale=0.4, **kind):
    """A network that nobody trained; its outputs grow with the commands, as a robot's do."""
    architecture, random = Architecture(**kind), np.random.default_rng(seed)
    weights = {
        name: random.normal(size=shape) * (scale if len(shape) > 1 else 0.2)
        for name, shape in architecture.shapes.items()
    }
    network = Network(architecture, weights)
    # Signs and mixture of the outputs such that both gains are one at rest.
    gain = network_gain(network)
    weights["output"] = weights["output"] @ np.linalg.inv(gain)
    weights["output_offset"] = np.array([0.03, -0.02])
    return Network(architecture, weights)


def network_gain(network, step=1e-5):
    """(2, 2) what each input's small command for ever adds to the outputs, by input."""
    held = np.array([np.tile(step * unit, (network.architecture.window, 1)) for unit in (*np.eye(2), *-np.eye(2))])
    says = network(held)
    return (says[:2] - says[2:]) / (2 * step)


def random_model(seed=0, scale=0.4, **kind):
    return network_model("network", random_network(seed, scale, **kind), DT)
