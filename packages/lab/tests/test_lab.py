"""The laboratory in a real browser: drives equal to those of Python, links, controls and files."""

import fcntl
import importlib.util
import re
import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from firefox import opened_firefox
from typer.testing import CliRunner

from browser import open_browser
from commands import invoke
from diffdrive_mpc import Controller, integrate_pose, load_trajectory
from diffdrive_mpc.app.cli import app
from diffdrive_mpc.sim import make_plant, simulate
from diffdrive_mpc.sim.plants.surface import load_surface
from diffdrive_mpc_extras.peers.rpp import RegulatedPurePursuit
from diffdrive_mpc_lab import build
from diffdrive_mpc_lab.build import experiments, page_text, sources_digest
from diffdrive_mpc_lab.numbers import FLOOR, configuration, default_of, lab_settings, plant_functions, values_of

COMMITTED_PAGE = Path(__file__).parents[3] / "docs" / "laboratory" / "index.html"
in_browser = pytest.mark.system("browser")
PATHS = ("circle", "square", "s", "cane")
DRIVES = "laboratory.activeDrives"
# Tolerance of commands [m/s, rad/s] and poses [m, rad]: WebAssembly has no fused multiply-add and another libm.
ROUNDING = 1e-11


@pytest.fixture(scope="session")
def page_file(tmp_path_factory: pytest.TempPathFactory, testrun_uid: str) -> Path:
    """The page, built once for all workers."""
    page = tmp_path_factory.getbasetemp().parent / f"lab-{testrun_uid}.html"
    with page.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not page.exists():
            page.write_text(page_text(), encoding="utf-8")
    return page


def test_committed_page_is_up_to_date() -> None:
    (digest,) = re.findall(r'<meta name="sources" content="(\w+)">', COMMITTED_PAGE.read_text(encoding="utf-8"))
    assert digest == sources_digest(), "docs/laboratory/index.html is out of date: run make lab and commit it"


def test_digest_names_changed_numbers_and_ignores_rounding(monkeypatch: pytest.MonkeyPatch) -> None:
    index, data = build._data_of_page()
    numbers, digests = np.frombuffer(data, "<f8"), [sources_digest()]
    for factor in (1.0 + 1e-15, 1.0 + 1e-4):
        changed = np.where(np.arange(len(numbers)) < 50, factor, 1.0) * numbers
        monkeypatch.setattr(build, "_data_of_page", lambda bound=changed: (index, bound.tobytes()))
        digests.append(sources_digest())
    assert digests[0] == digests[1] != digests[2]


@contextmanager
def laboratory(page_file: Path, link: str = "", **options: Any) -> Iterator[Any]:
    """Open the page from the file system without a network; at the end, check that there were no errors or requests."""
    errors: list[str] = []
    requests: list[str] = []
    with open_browser() as browser:
        settings = {"viewport": {"width": 1280, "height": 900}, "offline": True, "accept_downloads": True} | options
        page = browser.new_context(**settings).new_page()
        page.on("console", lambda message: errors.append(message.text))
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on("request", lambda request: requests.append(request.url))
        visit(page, page_file, link)
        yield page
        assert errors == []
        assert {url.partition("#")[0] for url in requests if not url.startswith(("data:", "blob:"))} == {
            page_file.as_uri()
        }


def visit(page: Any, page_file: Path, link: str = "") -> None:
    page.goto("about:blank")
    page.goto(page_file.as_uri() + (f"#{link}" if link else ""))
    page.wait_for_selector("html[data-ready]", state="attached")


def evaluated_rmse(page: Any) -> float:
    """Wait for the drive with the current settings to be evaluated; return its position RMSE [m]."""
    page.wait_for_function("() => laboratory.evaluation !== null")
    return float(page.evaluate("laboratory.evaluation.rms"))


def choices(page: Any) -> dict[str, Any]:
    return dict(page.evaluate("laboratory.choices"))


def centre_of(node: Any) -> tuple[float, float]:
    """Return the centre of an element on the screen after scrolling to it."""
    node.scroll_into_view_if_needed()
    box = node.bounding_box()
    return box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"]


# Without a browser.


def test_c_formulas_equal_those_of_the_plant() -> None:
    slip_function, pose_function = plant_functions()
    slip = load_surface("ice").slip
    output, pose = np.array([0.7, -0.9]), np.array([0.3, -0.2, 2.0])
    body, wheels = slip_function(output, [getattr(slip, name) for name in FLOOR])
    assert body.full().ravel() == pytest.approx(slip.body(output), abs=1e-15)
    assert wheels.full().ravel() == pytest.approx(slip.turned(*output), abs=1e-15)
    v, lateral, omega = slip.body(output)
    expected = integrate_pose(pose, v, omega, 0.02, -lateral / (v * omega))
    end_pose = pose_function(pose, ca.DM([v, lateral, omega]), 0.02).full().ravel()
    assert end_pose == pytest.approx(expected, abs=1e-15)


def test_missing_compiler_is_reported_with_the_remedy(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    result = CliRunner().invoke(app, ["lab", "--out", str(tmp_path / "lab.html")])
    assert result.exit_code == 1
    assert result.output == "error: the laboratory needs Zig's C compiler: pip install ziglang\n"
    assert not list(tmp_path.iterdir())


# In the browser.


@in_browser
def test_drives_equal_those_of_python(page_file: Path) -> None:
    """Compare commands, poses and peer commands of twelve drives with active limits and changed weights."""
    settings_by_model = {"ssm": (700, 6), "sm": (333.3, 3), "mbm": (1500, 7.25)}
    with laboratory(page_file, "path=s") as page:
        evaluated_rmse(page)
        default = choices(page)
        for model, (across, slew) in settings_by_model.items():
            for path in PATHS:
                selected = default | {"model": model, "robot": model, "path": path, "across": across, "slew": slew}
                result = page.evaluate("(chosen) => laboratory.evaluator.drive(chosen)", selected)
                config = configuration(model, {"told": 0.04, "across": across, "slew": slew})
                reference, plant = load_trajectory(path, config), f"model:{model}+0.04"
                run = simulate(Controller(config), make_plant(plant), reference)
                peer = simulate(RegulatedPurePursuit(), make_plant(plant), reference)
                assert np.abs(run.command - np.array(result["commands"])).max() < ROUNDING
                assert np.abs(run.true_pose - np.array(result["poses"])).max() < ROUNDING
                assert np.abs(peer.command - np.array(result["peer"])).max() < ROUNDING
                assert result["rms"] == pytest.approx(run.metrics.position_rmse_m, abs=1e-12)


@pytest.mark.system("firefox")
def test_drives_in_firefox_equal_those_of_python_and_a_hostile_link_is_refused(page_file: Path, tmp_path: Path) -> None:
    ready = "async () => { while (!window.laboratory?.evaluation) await new Promise((go) => setTimeout(go, 20)); }"
    with opened_firefox("firefox-esr", tmp_path) as tab:
        tab.open(f"{page_file.as_uri()}#horizon=1e308")
        tab.evaluate(f"async () => {{ await ({ready})(); return null; }}")
        notice, selected = tab.evaluate("() => [document.getElementById('notice').textContent, laboratory.choices]")
        assert "'horizon=1e308' is not a valid choice" in notice
        assert selected["horizon"] == default_of("horizon")
        for path in PATHS:
            changed = selected | {"path": path, "dead": 0.04, "told": 0.04}
            result = tab.evaluate("(chosen) => laboratory.evaluator.drive(chosen)", changed)
            config = configuration("ssm", {"told": 0.04})
            run = simulate(Controller(config), make_plant("model:ssm+0.04"), load_trajectory(path, config))
            assert np.abs(run.command - np.array(result["commands"])).max() < ROUNDING


@in_browser
def test_saved_files_reproduce_the_error_of_the_page_in_simulate(page_file: Path, tmp_path: Path) -> None:
    """Use a shipped path, a path at another speed and a drawn path, with lost poses, ice and other limits."""
    drawn_path = "drawn=0,0;60,5;120,50;180,60;240,10;300,0"
    links = (
        "path=circle&dead=0.12&told=0.08&surface=ice&sensors=half_lost&seed=1&horizon=20&slew=3",
        "path=slalom&speed=0.8&model=mbm&robot=sm&wheel=1.19",
        f"{drawn_path}&speed=0.5&model=kinematic&sensors=perfect&smooth=35",
    )
    with laboratory(page_file) as page:
        for number, link in enumerate(links):
            visit(page, page_file, link)
            rms = evaluated_rmse(page)
            assert page.evaluate("location.hash.slice(1).split('&').sort()") == sorted(link.split("&"))
            folder = tmp_path / str(number)
            for button in ("#save", "#savepath"):
                if page.locator(button).is_visible():
                    with page.expect_download() as download:
                        page.locator(button).click()
                    download.value.save_as(folder / download.value.suggested_filename)
            command = page.locator("#command").inner_text()
            assert f"# {command}" in (folder / "lab.yaml").read_text()
            arguments = [str(folder / name) if (folder / name).exists() else name for name in shlex.split(command)[1:]]
            output = invoke(app, *arguments).stdout
            assert f"position RMSE {1000 * rms:.1f} mm" in output


@in_browser
def test_unusable_link_opens_the_first_experiment_with_a_notice(page_file: Path) -> None:
    script = "<script>document.title='taken'</script><img src=x onerror=document.title='taken'>"
    links = (
        "horizon=1e308",
        "across=-1e308&path=circle",
        "ice=1e308,1",
        "drawn=" + ";".join(["0,0"] * 65),
        f"path={script}",
        f"{script}=1",
        "__proto__=1",
        "path=circle&path=square",
        "a.path=circle&b.path=square",
        "across=49.9",
        "%E0%A4%A",
        "path=" + "x" * 1_000_000,
    )
    with laboratory(page_file) as page:
        default_choices = choices(page)
        title = page.title()
        for link in links:
            page.evaluate("(link) => { location.hash = link }", link)
            page.wait_for_function("() => !document.getElementById('notice').hidden")
            notice = page.locator("#notice").inner_text()
            assert notice.startswith("This link cannot be used, so the first experiment is shown: ")
            assert len(notice) < 160
            assert "\n" not in notice
            assert choices(page) == default_choices
            assert page.title() == title
            page.evaluate("laboratory.choose({ seed: 0 })")
        visit(page, page_file, "path=" + "x" * 1_000_000)
        assert choices(page) == default_choices


@in_browser
def test_each_control_changes_a_setting_that_the_link_restores(page_file: Path) -> None:
    with laboratory(page_file) as page:
        for name in lab_settings()["choices"]:
            control = page.locator(f"#choice-{name}")
            changed = next(value for value in values_of(name) if value != default_of(name))
            if control.evaluate("(node) => node.type") == "range":
                control.fill(str(values_of(name).index(changed)))
            else:
                control.select_option(str(changed))
            assert choices(page)[name] == changed
        changed_choices = choices(page)
        evaluated_rmse(page)
        visit(page, page_file, page.evaluate("location.hash.slice(1)"))
        assert choices(page) == changed_choices
        assert page.locator("#notice").is_hidden()


@in_browser
def test_pointer_touch_and_keyboard_act_as_documented(page_file: Path) -> None:
    with laboratory(page_file, viewport={"width": 390, "height": 844}, has_touch=True) as page:
        assert page.evaluate("document.documentElement.scrollWidth") <= 390
        floor = page.locator("#floor")
        page.wait_for_function("() => laboratory.report.time > 0.5")
        page.touchscreen.tap(*centre_of(floor))
        page.wait_for_function("() => laboratory.report.error > 0.1")
        page.locator("#tool-ice").tap()
        page.touchscreen.tap(*centre_of(floor))
        assert len(choices(page)["ice"]) == 1
        assert "ice=" in page.evaluate("location.hash")
        assert page.locator("#without-ice").is_visible()
        page.locator("#tool-draw").click()
        x, y = centre_of(floor)
        page.mouse.move(x, y)
        page.mouse.down()
        for step in range(20):
            page.mouse.move(x + 6 * step, y + 3 * step)
        page.mouse.up()
        assert len(choices(page)["drawn"]) > 3
        page.keyboard.press("Space")
        paused_at = page.evaluate("laboratory.paused && laboratory.report.pose[0]")
        page.keyboard.press("ArrowRight")
        assert page.evaluate("laboratory.report.pose[0]") == pytest.approx(paused_at + 0.05)
        page.keyboard.press("c")
        page.keyboard.press("Space")
        assert page.locator("#cover").get_attribute("aria-pressed") == "true"
        page.wait_for_function("() => laboratory.report.mode >= 2")
        page.keyboard.press("p")
        page.keyboard.press("r")
        page.wait_for_function("() => laboratory.report.time < 0.5")


@in_browser
def test_experiments_show_both_drives_with_their_figures(page_file: Path) -> None:
    with laboratory(page_file) as page:
        for number, experiment in enumerate(experiments()):
            if number:
                page.locator(f"#experiment-{experiment['name']}").click()
            assert page.locator("[id^=experiment-][aria-pressed=true]").inner_text() == experiment["title"]
            assert page.locator("#explanation").inner_text() == experiment["see"]
            page.wait_for_function(f"() => {DRIVES}.length === 2 && {DRIVES}.every((drive) => drive.evaluation)")
            rms = page.evaluate(f"{DRIVES}.map((drive) => drive.evaluation.rms)")
            assert rms[1] <= experiment["share"] * rms[0], experiment["name"]
            displayed = [page.locator(f"#rms-{side}").inner_text() for side in "ab"]
            assert displayed == [f"{1000 * value:.1f} mm" for value in rms]


@in_browser
def test_link_opens_a_comparison_with_the_marked_drive(page_file: Path) -> None:
    sides = "() => Object.values(laboratory.drives).map((drive) => drive.choices)"
    with laboratory(page_file, "path=circle&across=333.3&b.path=circle&b.ice=0,200") as page:
        first, second = drives = page.evaluate(sides)
        assert (first["across"], first["ice"], second["ice"]) == (333.3, [], [[0, 2]])
        assert choices(page) == first
        page.locator("#side-b").click()
        visit(page, page_file, page.evaluate("location.hash.slice(1)"))
        assert page.evaluate(sides) == drives
        assert choices(page) == second
        page.locator("#number-dead").fill("0.08")
        page.keyboard.press("Enter")
        assert [drive["dead"] for drive in page.evaluate(sides)] == [0.04, 0.08]
        page.locator("#compare").click()
        assert page.evaluate("laboratory.activeDrives.length") == 1
        assert page.locator("#rms-a").is_hidden()


@in_browser
def test_typed_number_is_used_or_replaced_by_the_nearest_valid_number_with_a_notice(page_file: Path) -> None:
    expected = (("across", "612.5", 612.5), ("across", "1", 50), ("horizon", "33", 30), ("told", "", 0.12))
    with laboratory(page_file) as page:
        for name, text, value in expected:
            page.locator(f"#number-{name}").fill(text)
            page.keyboard.press("Enter")
            assert (choices(page)[name], page.locator(f"#number-{name}").input_value()) == (value, str(value))
            assert page.locator("#notice").is_visible() == (text != str(value))
            assert page.locator(f"#number-{name}.replaced").count() == (text != str(value))


@in_browser
def test_tools_and_figures_are_above_the_fold_and_keys_act_without_scrolling(page_file: Path) -> None:
    with laboratory(page_file, viewport={"width": 1400, "height": 900}) as page:
        for name in ("floor", "tools", "actions", "keys", "rms-a", "rms-b", "mode-b", "charts", "choice-seed"):
            assert page.locator(f"#{name}").evaluate("(node) => node.getBoundingClientRect().bottom") <= 900, name
        for selector in ("#push", "#side-a", "#choice-slew", "#choices"):
            page.locator(selector).click()
            page.keyboard.press("Space")
            assert page.evaluate("laboratory.paused") == (selector in ("#push", "#choice-slew")), selector
        page.keyboard.press("ArrowDown")
        assert page.evaluate("window.scrollY") == 0
        page.keyboard.press("Control+c")
        assert page.locator("#cover").get_attribute("aria-pressed") == "false"
