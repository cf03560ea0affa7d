"""Forms of a channel of user structures."""

from dataclasses import replace
from typing import ClassVar, Literal

import numpy as np
import pytest
from log_parts import MAPPING, write_csv, write_mapping

from diffdrive_mpc import identify, load_model
from diffdrive_mpc.models.checked_yaml import StrictModel
from diffdrive_mpc.models.structures import registry
from diffdrive_mpc.models.structures.model_file import Finite, ModelFile, TwoPoles, build_model
from diffdrive_mpc.models.structures.sm import identify_sm
from diffdrive_mpc.models.structures.structure import Structure, StructureFit
from diffdrive_mpc.models.structures.two_poles import TWO_POLES
from diffdrive_mpc.models.velocity_model import CHANNELS

TRUTH = {
    "v": {"gain": 0.95, "natural_frequency": 9.0, "damping": 1.3, "zero": 0.06},
    "omega": {"gain": 0.8, "natural_frequency": 7.0, "damping": 0.7, "zero": -0.03},
}
DEAD_TIME = {"v": 0.06, "omega": 0.05}
LIMIT = 0.6
DT = 0.02


class TwoPolesAndZero(TwoPoles):
    """gain w^2 (1 + zero s) / (s^2 + 2 damping w s + w^2)."""

    zero: Finite

    @staticmethod
    def realisation(values):
        A, B, C = TwoPoles.realisation(values[:3])
        return A, B, C + values[3] * values[1] * np.array([[0.0, 1.0]])

    @staticmethod
    def lag(values):
        return TwoPoles.lag(values[:3]) - values[3]


class ZeroChannels(StrictModel):
    v: TwoPolesAndZero
    omega: TwoPolesAndZero


class ZeroFile(ModelFile):
    """SM with a zero in each channel."""

    structure: Literal["zeros"]
    channels: ZeroChannels

    def transfer_functions(self):
        return dict(self.channels)


class ZeroForm:
    """Form with the logarithms of `TwoPolesForm`, and the time constant of the zero."""

    file = TwoPolesAndZero
    description = "two poles, a zero"
    kinds: ClassVar = {**TWO_POLES.kinds, "zero": "effect"}
    names = tuple(kinds)
    may_be_zero = ("zero",)

    @property
    def bounds(self):
        low, high = TWO_POLES.bounds
        return np.append(low, -1.0), np.append(high, 1.0)

    def values(self, parameters):
        return np.append(TWO_POLES.values(parameters[:3]), parameters[3])

    def initial_guesses(self, gain, frequency):
        (poles,) = TWO_POLES.initial_guesses(gain, frequency)
        return [np.append(poles, zero) for zero in (0.0, -0.5 / frequency, 0.5 / frequency)]

    def matrices(self, parameters):
        return self.file.realisation(self.values(parameters))

    def recentred(self, parameters):
        return self, parameters


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    """Identification from a drive of the true model with commands clipped at a level, and the model of its files."""
    folder = tmp_path_factory.mktemp("zeros")
    provenance = {"origin": "assumed", "source": "this test"}
    truth = {"name": "truth", "structure": "zeros", "provenance": provenance, "dead_time": DEAD_TIME, "channels": TRUTH}
    rng = np.random.default_rng(3)
    command = np.repeat(rng.uniform([-1.0, -1.5], [1.0, 1.5], (200, 2)), 25, axis=0)
    clipped = np.clip(command, [-LIMIT, -np.inf], [LIMIT, np.inf])

    def identify_zeros(records, conditions):
        return StructureFit(identify_sm(records, yaw=conditions.yaw, form=ZeroForm(), schema=ZeroFile))

    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(registry.STRUCTURES, "zeros", Structure("zeros", ZeroFile, identify_zeros))
        twist = build_model(ZeroFile.model_validate(truth)).discretise(DT).simulate(clipped)
        columns = {"t": DT * np.arange(len(command)), "v_ref": command[:, 0], "omega_ref": command[:, 1]}
        readings = dict(zip(("v", "gyro"), (twist + rng.normal(0.0, 0.01, twist.shape)).T, strict=True))
        write_csv(folder / "drive.csv", columns | readings | {"omega_wheels": twist[:, 1]})
        write_mapping(folder / "map.yaml", "\n".join(line for line in MAPPING.splitlines() if "pose" not in line))
        identification = identify(folder / "drive.csv", folder / "map.yaml", "zeros")
        identification.write(folder / "written")
        yield identification, load_model(folder / "written" / "model.yaml")


def test_true_values_and_the_limit_are_within_the_intervals(result):
    parameters = result[0].report.fitted.identified.parameters
    truth = {f"{name}.{key}": value for name in CHANNELS for key, value in TRUTH[name].items()}
    truth |= {f"{name}.dead_time": DEAD_TIME[name] for name in CHANNELS} | {"v.forward": LIMIT, "v.reverse": LIMIT}
    assert set(parameters.names) == {*truth, "omega.offset"}
    errors = {name: (parameters.value(name) - value) / parameters.deviation(name) for name, value in truth.items()}
    assert max(map(abs, errors.values())) < 4.0, errors
    assert parameters.deviation("omega.zero") < 0.005


def test_file_loads_as_the_identified_model(result):
    identification, loaded = result
    for name in ("A", "B", "C", "dead_time"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(identification.model, name))
    assert identification.config["limits"]["v"] == pytest.approx(LIMIT, abs=0.01)
    assert "two poles, a zero and a dead time for each channel" in loaded.provenance["method"]


def test_delays_and_poles_follow_from_the_form(result):
    identified = result[0].report.fitted.identified
    assert [identified.delays.value(f"{name}.sum") for name in CHANNELS] == pytest.approx(result[1].lag, rel=1e-6)
    estimates = dict(zip(CHANNELS, identified.poles, strict=True))
    assert [estimates[name].names for name in CHANNELS] == [("pole_1", "pole_2"), ("pole_1.real", "pole_1.imag")]
    assert estimates["omega"].values == pytest.approx(7.0 * np.array([-0.7, np.sqrt(1 - 0.49)]), rel=0.02)


def test_parameters_undetermined_by_a_short_noisy_log_are_doubts(result):
    """The doubts concern the form of the response; an uncertain zero causes no doubt."""
    record = result[0].report.data.train[0].part(0, 400)
    rng = np.random.default_rng(0)
    noisy = replace(record, twist=record.twist + rng.normal(0.0, 0.5, record.twist.shape))
    doubts = [
        doubt for doubt in identify_sm([noisy], form=ZeroForm(), schema=ZeroFile).warnings if "v:" in doubt.message
    ]
    assert doubts
    assert not [doubt for doubt in doubts if "zero = " in doubt.message]
