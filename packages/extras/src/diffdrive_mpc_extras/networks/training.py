"""Training of a network, with JAX and Optax from the extra `learn`."""

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

Share = Annotated[float, Field(gt=0, lt=1)]
Count = Annotated[int, Field(ge=1)]


class TrainingSettings(StrictModel):
    """Settings of the training; `training.yaml` contains the values and their sources."""

    optimiser: Literal["adam", "rmsprop"] = Field(description="optimiser: Adam or RMSProp")
    batch: Count = Field(description="number of windows per step")
    decay: float = Field(ge=0, description="factor of the L2 regularisation of the weights")
    dropout: float = Field(ge=0, lt=1, description="dropout rate of the output of the last recurrent layer")
    validation_every: Count = Field(description="number of steps between two validations")
    patience: Count = Field(description="number of validations without improvement after which the training stops")
    shares: tuple[Share, Share, Share] = Field(description="shares of training, validation and test, in temporal order")
    rate: float = Field(gt=0, description="learning rate of the optimiser")
    max_epochs: Count = Field(description="maximum number of epochs")
    seed: int = Field(ge=0, description="seed of weights, batches and dropout")


@cache
def training_settings() -> TrainingSettings:
    """Load the shipped settings; raise ConfigError if the file is invalid."""
    return load_checked(TrainingSettings, Path(__file__).parent / "training.yaml")


_WEIGHTS = ("input_", "recurrent_", "dense", "output")
Parameters = Mapping[str, Any]


@dataclass(frozen=True)
class Training:
    """Result of a training.

    Attributes
    ----------
    network
        Network with the smallest validation loss.
    steps
        Total number of steps.
    best_step
        Number of steps until the smallest validation loss.
    losses
        (validations,) validation losses: half the squared error, summed over both outputs, averaged over windows.
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
    on_validation: Callable[[int, float], None] | None = None,
) -> Training:
    """Train a network until the loss on `validation` no longer improves.

    The loss is that of P1's software: half the squared error, summed over both outputs and averaged over the batch,
    plus half of `decay` times the squared weights. The weights are reproducible by seed, bit for bit, on one machine.

    Parameters
    ----------
    architecture
        Architecture of the network.
    training, validation
        Windows of the architecture's length.
    settings
        Settings of the training, by default the shipped settings.
    on_validation
        Callback with the number of steps and the validation loss.

    Raises
    ------
    models.errors.MissingPackageError
        If JAX or Optax are not installed.
    ValueError
        If there are too few windows.
    """
    jax, _ = _import_libraries()
    s = settings or training_settings()
    chunk = s.batch * s.validation_every
    if len(training) < chunk or not len(validation):
        raise ValueError(
            f"{len(training)} windows for training and {len(validation)} for validation; training needs at least "
            f"{chunk}: give a longer log"
        )
    random = np.random.default_rng(s.seed)
    weights = _initial_weights(architecture, random)
    parameters = {name: jax.numpy.asarray(value, "float32") for name, value in weights.items()}
    optimiser, run, loss = _compile(architecture, s.optimiser, s.rate, s.dropout, s.decay)
    state, key = optimiser.init(parameters), jax.random.PRNGKey(s.seed)
    inputs, targets = training.commands.astype("float32"), training.twists.astype("float32")
    held_out = validation.commands.astype("float32"), validation.twists.astype("float32")
    best, losses = parameters, [float(loss(parameters, *held_out))]
    for count in range(s.max_epochs * (len(training) // chunk)):
        if count % (len(training) // chunk) == 0:
            order = random.permutation(len(training))
        first = count % (len(training) // chunk) * chunk
        rows = order[first : first + chunk].reshape(s.validation_every, s.batch)
        parameters, state, key = run(parameters, state, key, inputs[rows], targets[rows])
        losses.append(float(loss(parameters, *held_out)))
        if on_validation:
            on_validation(s.validation_every * (count + 1), losses[-1])
        if losses[-1] < min(losses[:-1]):
            best = parameters
        if len(losses) - 1 - int(np.argmin(losses)) >= s.patience:
            break
    network = Network(architecture, {name: np.asarray(value, dtype=float) for name, value in best.items()})
    steps = s.validation_every * np.array([len(losses) - 1, int(np.argmin(losses))])
    return Training(network, int(steps[0]), int(steps[1]), np.array(losses))


def method(architecture: Architecture, settings: TrainingSettings, training: Training) -> str:
    """Describe the training of a network, for the provenance in its file."""
    s, a = settings, architecture
    shares = ", ".join(f"{share:.0%}" for share in s.shares)
    return (
        f"{s.optimiser} at {s.rate:g} with L2 {s.decay:g}, batches of {s.batch}, dropout {s.dropout:g}; validation "
        f"every {s.validation_every} steps, best of {training.steps} steps at {training.best_step}, "
        f"patience {s.patience}; "
        f"shares of training, validation and test {shares}, in temporal order; seed {s.seed}; window {a.window}, "
        f"{a.layers} x LSTM of {a.units}, dense {a.dense} with {a.activation}, {a.parameters} parameters"
    )


def check_installed() -> None:
    """Raise MissingPackageError if JAX or Optax are not installed."""
    _import_libraries()


def _import_libraries() -> tuple[Any, Any]:
    try:
        import jax  # noqa: PLC0415 - only training needs it
        import optax  # noqa: PLC0415
    except ImportError as error:
        raise MissingPackageError(
            "training a network needs JAX and Optax: pip install 'diffdrive-mpc[learn]'"
        ) from error
    return jax, optax


def _initial_weights(architecture: Architecture, random: np.random.Generator) -> dict[str, FloatArray]:
    """Draw initial weights: Glorot uniform; recurrent weights are orthogonal, offsets of the forget gates are 1."""
    weights: dict[str, FloatArray] = {}
    for name, shape in architecture.shapes.items():
        if len(shape) == 1:
            weights[name] = np.zeros(shape)
            if name.startswith("gate_offset"):
                weights[name][architecture.units : 2 * architecture.units] = 1.0
        elif name.startswith("recurrent"):
            blocks = [np.linalg.qr(random.normal(size=(shape[0], shape[0])))[0] for _ in range(4)]
            weights[name] = np.hstack(blocks)
        else:
            width = shape[1] // 4 if name.startswith("input") else shape[1]
            weights[name] = random.uniform(-1, 1, shape) * np.sqrt(6.0 / (shape[0] + width))
    return weights


@cache
def _compile(
    architecture: Architecture, optimiser: str, rate: float, dropout: float, decay: float
) -> tuple[Any, Callable[..., Any], Callable[..., Any]]:
    """Return the optimiser, a compiled function of several training steps, and the compiled validation loss."""
    jax, optax = _import_libraries()
    rule = optax.adam(rate) if optimiser == "adam" else optax.rmsprop(rate)
    jnp = jax.numpy

    def evaluate(p: Parameters, windows: Any, key: Any) -> Any:  # noqa: ANN401 - arrays of JAX
        rows = jnp.swapaxes(windows, 0, 1)
        zero = jnp.zeros((windows.shape[0], architecture.units), "float32")
        for layer in range(architecture.layers):
            recurrent = p[f"recurrent_{layer}"]

            def advance(carry: Any, layer_input: Any, recurrent: Any = recurrent) -> Any:  # noqa: ANN401
                out, cell = carry
                input_gate, forget_gate, candidate, output_gate = jnp.split(layer_input + out @ recurrent, 4, axis=1)
                cell = next_cell(input_gate, forget_gate, candidate, cell, jnp.tanh)
                out = hidden(output_gate, cell, jnp.tanh)
                return (out, cell), out

            sums = rows @ p[f"input_{layer}"] + p[f"gate_offset_{layer}"]
            (last, _), rows = jax.lax.scan(advance, (zero, zero), sums)
        if key is not None and dropout:
            mask = jax.random.bernoulli(key, 1 - dropout, last.shape)
            last = jnp.where(mask, last / (1 - dropout), 0.0)
        dense = last @ p["dense"] + p["dense_offset"]
        dense = jnp.tanh(dense) if architecture.activation == "tanh" else jnp.maximum(dense, 0.0)
        return dense @ p["output"] + p["output_offset"]

    def error(p: Parameters, windows: Any, twists: Any, key: Any = None) -> Any:  # noqa: ANN401
        return 0.5 * jnp.mean(jnp.sum((evaluate(p, windows, key) - twists) ** 2, axis=1))

    def loss(p: Parameters, windows: Any, twists: Any, key: Any) -> Any:  # noqa: ANN401
        squares = [jnp.sum(p[name] ** 2) for name in p if name.startswith(_WEIGHTS) and not name.endswith("_offset")]
        return error(p, windows, twists, key) + 0.5 * decay * sum(squares)

    def step(carry: Any, batch: Any) -> Any:  # noqa: ANN401
        p, state, key = carry
        key, dropout_key = jax.random.split(key)
        change, state = rule.update(jax.grad(loss)(p, *batch, dropout_key), state)
        return (optax.apply_updates(p, change), state, key), None

    def run(p: Parameters, state: Any, key: Any, windows: Any, twists: Any) -> Any:  # noqa: ANN401
        return jax.lax.scan(step, (p, state, key), (windows, twists))[0]

    return rule, jax.jit(run), jax.jit(error)
