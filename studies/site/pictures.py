"""Pictures of the documents that are not figures of studies: results of commands, and the poster.

`python -m studies.site.pictures [NAME ...]`, run in the root folder of the repository, draws the pictures.
"""

from __future__ import annotations

import shlex
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from PIL import Image

from diffdrive_mpc import Controller, load_config, load_trajectory, make_plant, simulate
from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from studies.site.robot_scene import BLUE, GREY, ORANGE, RobotScene, draw_line

FOLDER = Path("docs/pictures")
_COLOURS = 64
"""Number of colours of a picture; the palette reduces the file to a third, and figures have few colours."""
POSTER, _POSTER_TIME = "poster", 5.2
"""Name of the picture of the robot, and time of the drive at which the robot is drawn [s]."""


class SitePicture(StrictModel):
    """Commands that draw a picture, and the path of the file that they write."""

    commands: list[str]
    shown: str


class Pictures(StrictModel):
    """Content of `pictures.yaml`: pictures by name."""

    pictures: dict[str, SitePicture]


def load_pictures() -> dict[str, SitePicture]:
    """Load `pictures.yaml`; raise ConfigError if the file is invalid."""
    return load_checked(Pictures, Path(__file__).with_name("pictures.yaml")).pictures


def draw(picture: SitePicture, target: Path) -> None:
    """Run the commands of a picture in a temporary folder, and write the picture to `target`.

    Raises
    ------
    subprocess.CalledProcessError
        If a command fails; a drive that does not complete is not a failure.
    """
    command = [sys.executable, "-c", "from diffdrive_mpc.app.cli import main; main()"]
    with TemporaryDirectory() as folder:
        for line in picture.commands:
            process = subprocess.run([*command, *shlex.split(line)], cwd=folder, check=False, stdout=subprocess.DEVNULL)
            # The exit code is 1 if a drive does not complete; pictures may show such drives.
            if process.returncode > 1:
                process.check_returncode()
        with Image.open(Path(folder) / picture.shown) as image:
            image.convert("RGB").quantize(_COLOURS, dither=Image.Dither.NONE).save(target, optimize=True)


def draw_poster(target: Path) -> None:
    """Drive the trajectory `s`, and render robot, driven path, reference and plan at `_POSTER_TIME`."""
    import mujoco  # noqa: PLC0415 - reads the environment's renderer setting on import

    config = load_config("ssm")
    reference = load_trajectory("s", config)
    run = simulate(Controller(config), make_plant("mujoco"), reference, keep_plans=True)
    tick = int(np.searchsorted(run.time, _POSTER_TIME))
    scene, camera, pose = RobotScene("mujoco"), mujoco.MjvCamera(), run.true_pose[tick]
    scene.place(pose, (0.3, 0.9, 0.6, 0.1))
    camera.lookat[:], camera.distance = (*pose[:2], 0.05), 1.2
    camera.azimuth, camera.elevation = np.degrees(pose[2]) + 32.0, -38.0
    with mujoco.Renderer(scene.model, 720, 1280, max_geom=5000) as renderer:
        renderer.update_scene(scene.data, camera)
        samples = reference.sample(np.linspace(0.0, reference.duration, 1000)).pose
        draw_line(renderer.scene, samples[:, :2], 0.004, GREY)
        draw_line(renderer.scene, run.true_pose[: tick + 1, :2], 0.006, BLUE)
        draw_line(renderer.scene, run.plans[tick][:, :2], scene.height, ORANGE)
        Image.fromarray(renderer.render()).quantize(_COLOURS * 2).save(target, optimize=True)


def main(names: list[str]) -> None:
    """Draw the pictures in `names`, or all pictures if `names` is empty."""
    FOLDER.mkdir(exist_ok=True)
    if not names or POSTER in names:
        draw_poster(FOLDER / f"{POSTER}.png")
    for name, picture in load_pictures().items():
        if not names or name in names:
            draw(picture, FOLDER / f"{name}.png")


if __name__ == "__main__":
    main(sys.argv[1:])
