"""Training a network with JAX and Optax, which the extra `learn` installs; nothing else needs them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.errors import MissingPackageError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.lstm_cell import hidden, next_cell
from diffdrive_mpc_extras.networks.network import Architecture, Network, Windows

# How networks are trained, read from `training.yaml`.


Share = Annotated[float, Field(gt=0, lt=1)]
Count = Annotated[int, Field(ge=1)]


class TrainingSettings(StrictModel):
    """The numbers of a training; where they come from stands in the file."""

    optimiser: Literal["adam", "rmsprop"] = Field(description="Adam, or RMSProp")
    batch: Count = Field(description="windows in a step")
    decay: float = Field(ge=0, description="L2 regularisation of weights")
    dropout: float = Field(ge=0, lt=1, description="of what the last recurrent layer says")
    validation_every: Count = Field(description="steps between two looks at the validation part")
    patience: Count = Field(description="looks without improvement until it stops")
    shares: tuple[Share, Share, Share] = Field(description="training, validation, test, in this order in time")
    rate: float = Field(gt=0, description="of the optimiser")
    most_epochs: Count
    seed: int = Field(ge=0)


@cache
def training_settings() -> TrainingSettings:
    """Load the shipped settings; raise ConfigError for a mistake in their file."""
    return load_checked(TrainingSettings, Path(__file__).parent / "training.yaml")


_WEIGHTS = ("input_", "recurrent_", "dense", "output")
Parameters = Mapping[str, Any]


@dataclass(frozen=True)
class Training:
    """Result of a training.

    Attributes
    ----------
    network
        Network at the smallest error on the validation part.
    steps
        Number of steps in all, and until the best look.
    best_step
        Steps until the best look.
    losses
        (looks,) half the squared errors of the validation part, summed over both outputs, mean over windows.
    """

    network: Network
    steps: int
    best_step: int
    losses: FloatArray


def train(
    architecture: Architecture,
    training: Windows,
    validation: Windows,
    settings: TrainingSettings | None = None,
    on_look: Callable[[int, float], None] | None = None,
) -> Training:
    """Train a network until it no longer improves on `validation`.

    The loss is that of P1's software: half the squared error, summed over both outputs, mean over the batch, with half
    of `decay` times the squared weights. The same seed gives the same weights, bit for bit, on the same machine.

    Parameters
    ----------
    architecture
        Architecture of the network.
    training, validation
        Windows of the architecture's length.
    settings
        By default the shipped ones.
    on_look
        Called with steps and loss at each look at the validation part.

    Raises
    ------
    models.errors.MissingPackageError
        If JAX or Optax are not installed.
    ValueError
        If there are fewer windows than a few batches.
    """
    jax, _ = _libraries()
    s = settings or training_settings()
    every = s.batch * s.validation_every
    if len(training) < every or not len(validation):
        raise ValueError(
            f"{len(training)} windows to train with and {len(validation)} to validate; a network needs {every} or "
            "more: give a longer log"
        )
    random = np.random.default_rng(s.seed)
    parameters = {name: jax.numpy.asarray(value, "float32") for name, value in _start(architecture, random).items()}
    rule, run, look = _compiled(architecture, s.optimiser, s.rate, s.dropout, s.decay)
    state, key = rule.init(parameters), jax.random.PRNGKey(s.seed)
    inputs, wanted = training.commands.astype("float32"), training.twists.astype("float32")
    held = validation.commands.astype("float32"), validation.twists.astype("float32")
    best, losses = parameters, [float(look(parameters, *held))]
    for count in range(s.most_epochs * (len(training) // every)):
        if count % (len(training) // every) == 0:
            order = random.permutation(len(training))
        place = count % (len(training) // every) * every
        rows = order[place : place + every].reshape(s.validation_every, s.batch)
        parameters, state, key = run(parameters, state, key, inputs[rows], wanted[rows])
        losses.append(float(look(parameters, *held)))
        if on_look:
            on_look(s.validation_every * (count + 1), losses[-1])
        if losses[-1] < min(losses[:-1]):
            best = parameters
        if len(losses) - 1 - int(np.argmin(losses)) >= s.patience:
            break
    network = Network(architecture, {name: np.asarray(value, dtype=float) for name, value in best.items()})
    steps = s.validation_every * np.array([len(losses) - 1, int(np.argmin(losses))])
    return Training(network, int(steps[0]), int(steps[1]), np.array(losses))


def method(architecture: Architecture, settings: TrainingSettings, training: Training) -> str:
    """Describe the training of a network, for its file."""
    s, a = settings, architecture
    shares = ", ".join(f"{share:.0%}" for share in s.shares)
    return (
        f"{s.optimiser} at {s.rate:g} with L2 {s.decay:g}, batches of {s.batch}, dropout {s.dropout:g}; validation "
        f"every {s.validation_every} steps, best of {training.steps} steps at {training.best_step}, "
        f"patience {s.patience}; "
        f"parts of {shares} in this order in time, of which the first trains and the second stops; seed {s.seed}; "
        f"window {a.window}, {a.layers} x LSTM of {a.units}, dense {a.dense} with {a.activation}, {a.parameters} "
        "parameters"
    )


def check_installed() -> None:
    """Raise MissingPackageError if JAX or Optax are not installed, before anything long begins."""
    _libraries()


def _libraries() -> tuple[Any, Any]:
    try:
        import jax  # noqa: PLC0415 - only training needs it
        import optax  # noqa: PLC0415
    except ImportError as error:
        raise MissingPackageError(
            "training a network needs JAX and Optax: pip install 'diffdrive-mpc[learn]'"
        ) from error
    return jax, optax


def _start(architecture: Architecture, random: np.random.Generator) -> dict[str, FloatArray]:
    """Draw initial weights: Glorot's uniform ones, recurrent ones orthogonal, and gates that preserve the cell."""
    start: dict[str, FloatArray] = {}
    for name, shape in architecture.shapes.items():
        if len(shape) == 1:
            start[name] = np.zeros(shape)
            if name.startswith("gate_offset"):
                start[name][architecture.units : 2 * architecture.units] = 1.0
        elif name.startswith("recurrent"):
            blocks = [np.linalg.qr(random.normal(size=(shape[0], shape[0])))[0] for _ in range(4)]
            start[name] = np.hstack(blocks)
        else:
            width = shape[1] // 4 if name.startswith("input") else shape[1]
            start[name] = random.uniform(-1, 1, shape) * np.sqrt(6.0 / (shape[0] + width))
    return start


@cache
def _compiled(
    architecture: Architecture, optimiser: str, rate: float, dropout: float, decay: float
) -> tuple[Any, Callable[..., Any], Callable[..., Any]]:
    """Compile the optimiser's rule, some steps of training at once, and the loss on held-out windows."""
    jax, optax = _libraries()
    rule = optax.adam(rate) if optimiser == "adam" else optax.rmsprop(rate)
    jnp = jax.numpy

    def says(p: Parameters, windows: Any, key: Any) -> Any:  # noqa: ANN401 - arrays of JAX
        rows = jnp.swapaxes(windows, 0, 1)
        zero = jnp.zeros((windows.shape[0], architecture.units), "float32")
        for layer in range(architecture.layers):
            recurrent = p[f"recurrent_{layer}"]

            def advance(carried: Any, layer_input: Any, recurrent: Any = recurrent) -> Any:  # noqa: ANN401
                out, cell = carried
                enter, keep, candidate, leave = jnp.split(layer_input + out @ recurrent, 4, axis=1)
                cell = next_cell(enter, keep, candidate, cell, jnp.tanh)
                out = hidden(leave, cell, jnp.tanh)
                return (out, cell), out

            sums = rows @ p[f"input_{layer}"] + p[f"gate_offset_{layer}"]
            (last, _), rows = jax.lax.scan(advance, (zero, zero), sums)
        if key is not None and dropout:
            keep = jax.random.bernoulli(key, 1 - dropout, last.shape)
            last = jnp.where(keep, last / (1 - dropout), 0.0)
        dense = last @ p["dense"] + p["dense_offset"]
        dense = jnp.tanh(dense) if architecture.activation == "tanh" else jnp.maximum(dense, 0.0)
        return dense @ p["output"] + p["output_offset"]

    def error(p: Parameters, windows: Any, twists: Any, key: Any = None) -> Any:  # noqa: ANN401
        return 0.5 * jnp.mean(jnp.sum((says(p, windows, key) - twists) ** 2, axis=1))

    def loss(p: Parameters, windows: Any, twists: Any, key: Any) -> Any:  # noqa: ANN401
        squares = [jnp.sum(p[name] ** 2) for name in p if name.startswith(_WEIGHTS) and not name.endswith("_offset")]
        return error(p, windows, twists, key) + 0.5 * decay * sum(squares)

    def step(carried: Any, batch: Any) -> Any:  # noqa: ANN401
        p, state, key = carried
        key, dropout_key = jax.random.split(key)
        change, state = rule.update(jax.grad(loss)(p, *batch, dropout_key), state)
        return (optax.apply_updates(p, change), state, key), None

    def run(p: Parameters, state: Any, key: Any, windows: Any, twists: Any) -> Any:  # noqa: ANN401
        return jax.lax.scan(step, (p, state, key), (windows, twists))[0]

    return rule, jax.jit(run), jax.jit(error)
