"""Send many random goals from a client process to a node process and check that memory and threads do not grow.

    python tests/mpc/follow_long.py --goals 100

A hundred goals take about ten minutes in lock step, faster than real time. Memory and threads are those of the node.
"""

import argparse
import json
import math
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

# Permitted growth of memory after the node has settled [MB].
_MAX_GROWTH = 4.0
FOLDER = Path(__file__).parent


def random_path(rng, start):
    """Return poses (n, 3) of one or two arcs from `start`; a quarter of the arcs are driven backwards."""
    pose, poses = np.array(start, dtype=float), [np.array(start, dtype=float)]
    for _ in range(rng.integers(1, 3)):
        direction, length, curvature = rng.choice([1.0, 1.0, 1.0, -1.0]), rng.uniform(0.3, 1.0), rng.uniform(-1.2, 1.2)
        for _ in range(round(length / 0.05)):
            pose = pose + 0.05 * np.array([direction * math.cos(pose[2]), direction * math.sin(pose[2]), curvature])
            poses.append(pose.copy())
    path = np.array(poses)
    if rng.random() < 0.5:
        path[-1, 2] = rng.uniform(-math.pi, math.pi)
    return path


def run(goals, seed):
    from follow_parts import SUCCEEDED, Client
    from ros_parts import DT, FakeBase

    from fuzz.node_process import NodeProcess

    rng = np.random.default_rng(seed)
    settings = {"autostart": True, "use_sim_time": True, "start_at_robot": False}
    node = NodeProcess(Path(tempfile.mkdtemp(), "node.log"), settings)
    base, client = FakeBase(lambda: time.sleep(0.0005)), Client()
    reached, errors, usages = 0, [], []

    def tick(duration=0.2 * DT):
        start = time.monotonic()
        base.step()
        while time.monotonic() - start < duration:
            base.spin()

    def has_commands():
        assert node.alive, node.log.read_text()[-2000:]
        base.silent(1)
        return bool(base.commands)

    try:
        base.until(has_commands, "the node")
        while not any(event["event"] == "ready" for event in client.events):
            tick()
        for number in range(goals):
            path, name = random_path(rng, base.plant.true_pose), str(number)
            client.send(name, path)
            while client.result(name) is None:
                tick()
            result, error = client.result(name), np.asarray(base.plant.true_pose) - path[-1]
            reached += result["status"] == SUCCEEDED
            errors.append((math.hypot(error[0], error[1]), abs(math.remainder(error[2], math.tau))))
            usages.append(node.used())
            client.events.clear()
            if result["status"] != SUCCEEDED or number % 10 == 9:
                print(number + 1, result["status"], result["words"], usages[-1], flush=True)
    finally:
        client.close()
        node.end()
        base.close()
    position, heading = np.array(errors).T
    settled = usages[min(9, goals - 1)]
    memory, threads = np.array(usages).T
    place_m, heading_rad = ({"median": float(np.median(x)), "max": float(x.max())} for x in (position, heading))
    memory_mb = {str(i): round(float(memory[i]), 1) for i in sorted({0, 9, 19, 49, goals - 1}) if i < goals}
    summary = {"goals": goals, "seed": seed, "succeeded": int(reached), "place_m": place_m, "heading_rad": heading_rad}
    summary |= {"memory_mb": memory_mb, "threads": {"first": int(threads[0]), "last": int(threads[-1])}}
    summary["threads"]["most"] = int(threads.max())
    print(json.dumps(summary, indent=2))
    growth = memory[-1] - settled[0]
    faults = [
        f"{goals - reached} goals were not reached" * (reached < goals),
        f"memory grew by {growth:.1f} MB after the tenth goal" * bool(growth > _MAX_GROWTH),
        f"the number of threads rose from {settled[1]} to {threads[-1]}" * bool(threads[-1] > settled[1]),
    ]
    if any(faults):
        sys.exit("; ".join(filter(None, faults)))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--goals", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    sys.path[:0] = [str(FOLDER), str(FOLDER.parent)]
    from ros_types.build import add_types

    add_types()
    run(options.goals, options.seed)
