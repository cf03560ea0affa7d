"""All fuzzers by name."""

from fuzz.case import Fuzzer
from fuzz.controller import ControllerFuzzer
from fuzz.core import CoreFuzzer
from fuzz.logs import LogFuzzer, ReplayFuzzer
from fuzz.references import ReferenceFuzzer
from fuzz.yaml_files import YamlFuzzer

FUZZERS: dict[str, Fuzzer] = {
    fuzzer.name: fuzzer
    for fuzzer in (ControllerFuzzer(), CoreFuzzer(), ReferenceFuzzer(), YamlFuzzer(), LogFuzzer(), ReplayFuzzer())
}
