"""Exported judge: on the host with all warnings, and on an emulated microcontroller in comparison with Python."""

from __future__ import annotations

import subprocess
import threading

import numpy as np
import pytest
from test_monitor_judge import RULES, START, random_drive

from commands import invoke
from diffdrive_mpc.app.cli import app
from diffdrive_mpc_monitor.export import rules_texts
from diffdrive_mpc_monitor.judge import Judge, rule_names

STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wshadow", "-Werror")
CORTEX = ("-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16", "-ffp-contract=off", "-O2")
LINK = ("-ffunction-sections", "-fdata-sections", "-Wl,--gc-sections", "-nostartfiles", "--specs=nano.specs")
EMULATOR = "qemu-system-arm -M netduinoplus2 -nographic -monitor none -serial stdio -icount shift=0,sleep=off"
TIMEOUT = 120.0
MESSAGES = ("start", "point", "reference", "odometry", "gyro", "pose", "says", "command", "tick", "reset")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    exported = tmp_path_factory.mktemp("judge") / "exported"
    invoke(app, "monitor", "--export", exported)
    return exported


def test_example_runs_with_sanitizers(folder):
    command = ["gcc", *STRICT, "-g", "-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    command += [f"-I{folder / 'ddmon'}", *map(str, sorted((folder / "ddmon").glob("*.c")))]
    program = folder / "example"
    subprocess.run([*command, str(folder / "examples" / "main.c"), "-lm", "-o", str(program)], check=True)
    output = subprocess.run([program], capture_output=True, text=True, check=True).stdout
    assert "the robot is off its path" in output and "final position" in output


def test_name_of_rules_cannot_inject_code():
    rules = RULES.model_copy(update={"name": "x */ int i; \\\n#error ??/"})
    header = rules_texts(rules)["rules.h"]
    assert header.count("*/") == 1 and "#error" not in header.splitlines() and "\\" not in header


class EmulatedJudge:
    """Judge on the STM32F4 of QEMU; messages of eight doubles in both directions."""

    def __init__(self, image):
        self.process = subprocess.Popen(
            [*EMULATOR.split(), "-kernel", str(image)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        # Kill a hanging emulator.
        self.watchdog = threading.Timer(TIMEOUT, self.process.kill)
        self.watchdog.start()
        assert self.read(1)[0] == 1.0

    def read(self, count):
        data = self.process.stdout.read(8 * count)
        assert len(data) == 8 * count, "no reply from the program"
        return np.frombuffer(data)

    def __call__(self, name, *numbers):
        frame = np.zeros(8)
        frame[: 1 + len(numbers)] = (MESSAGES.index(name), *numbers)
        self.process.stdin.write(frame.tobytes())
        self.process.stdin.flush()
        return self.read(8)

    def close(self):
        self.watchdog.cancel()
        self.process.kill()
        self.process.communicate()


def flatten_call(name, arguments, keywords):
    """Return the numbers of a call: now, stamp, values."""
    if name == "says":
        return (arguments[0], 0.0, float(keywords["drives"]))
    if name == "tick":
        return arguments
    now, stamp, *values = arguments
    return (now, stamp, *np.hstack([np.ravel(value) for value in values]).tolist())


@pytest.mark.system("microcontroller")
def test_microcontroller_gives_equal_verdicts(folder):
    """Compare rule, time and command of each call; sines differ only in their last bits."""
    image = folder / "judge.elf"
    sources = [*sorted((folder / "ddmon").glob("*.c")), *sorted((folder / "stm32f4").glob("*.c"))]
    command = ["arm-none-eabi-gcc", "-std=c99", "-Wall", "-Wextra", "-Werror", *CORTEX, *LINK]
    command += [f"-I{folder / 'ddmon'}", "-T", str(folder / "stm32f4" / "stm32f4.ld"), *map(str, sources)]
    subprocess.run([*command, "-lm", "--specs=nosys.specs", "-o", str(image)], check=True)
    judge, board, calls_after_stop = Judge(RULES, START), EmulatedJudge(image), 0
    try:
        board("start", START)
        for name, arguments, keywords in random_drive(0):
            result = getattr(judge, name)(*arguments, **keywords)
            if name == "reference":
                for point in arguments[1]:
                    board("point", arguments[0], 0.0, *point)
                assert board("reference", arguments[0])[0] == 1.0
                continue
            reply = board(name, *flatten_call(name, arguments, keywords))
            verdict = judge.verdict
            calls_after_stop += bool(verdict)
            if calls_after_stop > 100:
                break
            assert rule_names()[int(reply[3])] == verdict.rule
            if verdict:
                assert reply[4] == verdict.at
            if name in ("command", "tick"):
                assert bool(reply[0]) == (result is not None)
                assert result is None or np.abs(reply[1:3] - result).max() <= 1e-9
        assert judge.verdict
    finally:
        board.close()
