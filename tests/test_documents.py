"""Documents are correct: every command runs, every link resolves, every figure is a bench result."""

import json
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from commands import refusal
from diffdrive_mpc.app.cli import app
from quick_settings import quick_settings
from studies.cli import app as studies_app
from studies.documents import documents as twelve_drives
from studies.documents.documents import REPORTS, with_report

ROOT = Path(__file__).parents[1]
PACKAGE_PAGES = list(ROOT.glob("packages/*/docs/*.md"))
DOCUMENTS = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").glob("*.md"), *PACKAGE_PAGES])
# Tutorials are run as notebooks by test_tutorials.py.
PAGES = sorted([*(ROOT / "docs").glob("*.md"), *(ROOT / "docs").glob("tutorials/*.md"), *PACKAGE_PAGES])
PAGES_WITH_LINKS = sorted([*DOCUMENTS, ROOT / "CHANGELOG.md", ROOT / "SECURITY.md", *(ROOT / "docs").glob("*/*.md")])
FENCE = re.compile(r"^```(\w+)\n(.*?)^```", re.MULTILINE | re.DOTALL)
GENERATED = re.compile(r"<!-- ([\w-]+):begin -->.*?<!-- \1:end -->", re.DOTALL)
"""Pattern of a generated table."""
MAX_WORDS, MAX_PAGES = 42_000, 26
"""Limits of the hand-written documents."""
COMMAND = Path(sys.executable).with_name("diffdrive-mpc")
# CI executes these lines unchanged, after the setup by make.
CI_SCRIPT = "".join((ROOT / ".ci" / name).read_text(encoding="utf-8") for name in ("run", "long"))
RUN_IN_CI = {line.strip().removesuffix(" &&") for line in CI_SCRIPT.splitlines()}
# Commands that a line of .ci/run or .ci/long runs with additional options.
PART_OF_CI = {
    "python -m studies speed --out out/speed --quick --peers ours,casadi/sqpmethod --horizons 10": (
        'NAME=speed OPTIONS="--quick --horizons 10"'
    ),
    "python -m studies tracking --out out/tracking --quick --only cross": 'NAME=tracking OPTIONS="--quick',
}
# Commands that a separate test runs with the same options, in order to check their results.
RUN_IN_TESTS = {
    "diffdrive-mpc prove ssm --tolerance 0.01,0.02,0.05 --out passport": "packages/extras/tests/test_speed_passport.py",
    "diffdrive-mpc models compare drive.csv --kinds sm,ssm --parts 2": "packages/extras/tests/test_model_comparison.py",
    "diffdrive-mpc predict-error --config my_robot/config.yaml --trajectory path.yaml "
    "--learn-from 1.mcap --learn-from 2.mcap --out predicted": "packages/extras/tests/test_own_robot.py",
}
# Slow commands, which other tests run in a similar form: only `.ci/long tests` runs them.
SLOW_COMMANDS = {
    "python -m studies tracking --only floor --out out/floor",
    "python -m studies robustness --robots 3 --rates 10 --trajectories circle --out out/market",
    "diffdrive-mpc identify drive.csv square.csv s.csv --structure hybrid --out hybrid",
    "diffdrive-mpc simulate --model hybrid/model.yaml --trajectory cane",
    "diffdrive-mpc predict-error --config ssm --trajectory s --out predicted",
}
RESULT_FOLDERS = {"passport"}
"""Folders of results in `RUN_IN_TESTS`."""
SEPARATE_PROCESS = ("node", "sim-robot", "monitor")
# These pages describe the installation: .ci/tour.py runs them unchanged with only a wheel installed.
TOUR_PAGES = {ROOT / "README.md", ROOT / "docs" / "install.md"}
# Options that require a system program.
NEEDS = {"--emulate": "microcontroller"}
RUN_BY_CI = re.compile(
    r"make (bench|study NAME=(tracking|reproduce|speed)|site|test|test-system|lint|types|wheel|fuzz)$"
)


def blocks(document):
    return FENCE.findall(document.read_text(encoding="utf-8"))


def name_of(document):
    return str(document.relative_to(ROOT))


def as_system_tests(document):
    """Return a document and the commands to omit as parameters of the system suite, with the needs of its commands."""
    lines = [line for language, body in blocks(document) if language == "sh" for line in body.splitlines()]
    needs = [need for option, need in NEEDS.items() if any(option in line for line in lines)]
    slow, marks = SLOW_COMMANDS.intersection(lines), pytest.mark.system(*needs)
    shortened = pytest.param(document, slow, marks=marks, id=name_of(document))
    complete = pytest.param(document, set(), marks=[marks, pytest.mark.long], id=f"all of {name_of(document)}")
    return [shortened, complete] if slow else [shortened]


@pytest.mark.usefixtures("one_process", "quick_search")
@pytest.mark.parametrize(
    ("document", "omitted"), [test for page in sorted({*DOCUMENTS} - TOUR_PAGES) for test in as_system_tests(page)]
)
def test_every_command_and_example_runs(document, omitted, tmp_path, monkeypatch):
    """Examples run in order in one folder, after files are written as shown in the document."""
    monkeypatch.chdir(tmp_path)
    names = {"__name__": "__main__"}
    for language, body in blocks(document):
        if language == "yaml":
            name = re.match(r"# file: (\S+)\n", body)
            assert name, f"{name_of(document)}: a YAML example must name its file"
            (tmp_path / name[1]).write_text(body, encoding="utf-8")
        elif language == "python":
            exec(compile(body, name_of(document), "exec"), names)
        elif language == "sh":
            for line in body.strip().splitlines():
                arguments = shlex.split(line)
                if arguments[0] == "make":
                    assert RUN_BY_CI.match(line), f"{name_of(document)}: no test runs `{line}`"
                elif line in RUN_IN_CI or line in PART_OF_CI or line in RUN_IN_TESTS or line in omitted:
                    continue
                elif "$DIFFDRIVE_MPC_DATA" in line:
                    raise AssertionError(f"{name_of(document)}: .ci/run does not contain `{line}`")
                elif arguments[:3] == ["python", "-m", "studies"]:
                    invoke_command(studies_app, arguments[3:], "python -m studies")
                else:
                    assert arguments[0] == "diffdrive-mpc"
                    run_documented_command(arguments[1:], tmp_path)
        else:
            raise AssertionError(f"{name_of(document)}: no test runs blocks of {language}")


def run_documented_command(arguments, folder):
    """Run a command in this process, to save import time; nodes, which handle signals, run in a separate process."""
    if arguments[0] in SEPARATE_PROCESS:
        run([str(COMMAND), *arguments], folder)
        return
    invoke_command(app, arguments, "diffdrive-mpc")


def invoke_command(program, arguments, name):
    # Short searches are enough to show that a command runs.
    with quick_settings():
        result = CliRunner().invoke(program, arguments, prog_name=name)
    assert result.exit_code == 0, f"{arguments}: {result.output}\n{result.exception!r}"


def run(command, folder):
    result = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert result.returncode == 0, f"{command}: {result.stderr}"


def hand_written():
    """Return the hand-written text by document, without tables between markers and fenced code, which tests run.

    Reports of studies are generated. CHANGELOG.md records releases, and readmes in `sources` belong to exported code.
    """
    paths = {*ROOT.glob("*.md"), *(ROOT / "docs").glob("**/*.md"), *ROOT.glob("packages/*/**/*.md")}
    paths -= {path for path in (ROOT / "docs").glob("*/*.md") if path.parent.name != "tutorials"}
    paths -= {ROOT / "CHANGELOG.md", *ROOT.glob("packages/*/**/sources/*.md")}
    return {path: FENCE.sub("", GENERATED.sub("", path.read_text(encoding="utf-8"))) for path in sorted(paths)}


def test_hand_written_documents_are_short():
    """Count the pages of the site without the tables of parameters, and the words of all documents."""
    texts = hand_written()
    words = {name_of(path): len(re.findall(r"\S*\w\S*", text)) for path, text in texts.items()}
    pages = {*texts} & {*DOCUMENTS, *PAGES} - {ROOT / "docs" / "parameters.md"}
    print(f"{sum(words.values())} words on {len(pages)} pages and in {len(texts) - len(pages)} other documents")  # noqa: T201
    longest = sorted(words, key=words.__getitem__, reverse=True)[:5]
    assert sum(words.values()) <= MAX_WORDS, f"shorten or merge documents; the longest are {longest}"
    assert len(pages) <= MAX_PAGES, "merge pages"


def test_files_named_by_documents_and_ci_exist():
    texts = [page.read_text(encoding="utf-8") for page in PAGES_WITH_LINKS] + [CI_SCRIPT]
    named_files = {name for text in texts for name in re.findall(r"(?:packages/\w+/)?tests/[a-z_0-9/]+\.py", text)}
    robot_tests = re.search(r'robot="(.*)"', CI_SCRIPT)[1].split()
    named_files |= {f"tests/mpc/test_{name}.py" for name in robot_tests}
    assert len(named_files) > 10
    assert [name for name in sorted(named_files) if not (ROOT / name).is_file()] == []


@pytest.mark.parametrize(("line", "file"), RUN_IN_TESTS.items())
def test_commands_run_in_tests_match_the_documents(line, file):
    """Every word of the line is quoted in the file of the test, except for paths."""
    parts = shlex.split(line.removeprefix("python -m studies ").removeprefix("diffdrive-mpc "))
    expected_words = [f'"{part}"' for part in parts if "." not in part and part not in RESULT_FOLDERS]
    test = (ROOT / file).read_text(encoding="utf-8")
    assert all(part in test for part in expected_words), expected_words
    assert any(line in body.splitlines() for document in DOCUMENTS for _, body in blocks(document))


@pytest.mark.parametrize("document", PAGES_WITH_LINKS, ids=name_of)
def test_links_resolve(document):
    """Links inside the repository must exist; external addresses are only checked for their form."""
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", FENCE.sub("", document.read_text(encoding="utf-8"))):
        if "://" in target:
            assert re.fullmatch(r"https://[\w.-]+\.[a-z]+(/[\w./%~-]*)?", target), f"{name_of(document)}: {target}"
        else:
            assert (document.parent / target).exists(), f"{name_of(document)}: {target}"


@pytest.mark.parametrize("entry", REPORTS, ids=lambda entry: entry.name)
def test_pages_link_the_committed_report_and_show_its_tables(entry):
    """README shows the tables of `bench`; a report without a page of tables states its own revision and date."""
    report = (ROOT / "docs" / entry.name / f"{entry.name}.md").read_text(encoding="utf-8")
    if entry.page:
        page = (ROOT / "docs" / entry.page).read_text(encoding="utf-8")
        assert f"<!-- {entry.name}" in page
        assert with_report(entry, page, report) == page
    else:
        assert any(f"({entry.name}/{entry.name}.md" in page.read_text(encoding="utf-8") for page in PAGES)
        assert re.search(r"^\* diffdrive-mpc .*, revision [0-9a-f]{12}, \d{4}-\d\d-\d\d\.$", report, re.MULTILINE)


def test_reports_are_current_or_marked_as_older():
    record = json.loads((ROOT / twelve_drives.RECORD).read_text(encoding="utf-8"))
    assert twelve_drives.sums_agree(record["drives"], twelve_drives.drives()), (
        "the controller's commands have changed: make results, or python -m studies.documents.documents"
    )
    for entry in REPORTS:
        report = (ROOT / "docs" / entry.name / f"{entry.name}.md").read_text(encoding="utf-8")
        assert (twelve_drives.OLDER in report) == (entry.name not in record["reports"]), entry.name


@pytest.mark.parametrize("page", ["README.md", "docs/reproduce.md"])
def test_stated_number_of_confirmed_findings_agrees_with_the_report(page):
    report = (ROOT / "docs" / "reproduce" / "reproduce.md").read_text(encoding="utf-8")
    findings = report.partition("## Findings")[2].partition("\n## ")[0]
    verdicts = [line.split("|")[-2].strip() for line in findings.splitlines() if line.startswith("| ")][2:]
    assert f"{verdicts.count('yes')} of {len(verdicts)} hold" in (ROOT / page).read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (
            ["simulate", "--model", "smm"],
            "error: unknown model 'smm': give one of mbm, sm, ssm, two_delays, lstm, "
            "p2_experimental, p2_physical, kinematic or the path of a model",
        ),
        (["simulate", "--set", "weights.acros=1"], "unknown key 'weights.acros'; did you mean 'weights.across'?"),
        (["simulate", "--set", "horizon=0"], "horizon: Input should be greater than or equal to 1 (found 0)"),
    ],
)
def test_error_lines_match_the_documents(arguments, line):
    assert line in refusal(*arguments)
    documented = (ROOT / "docs" / "safety.md").read_text(encoding="utf-8")
    assert line.removeprefix("error: ") in documented
