"""Hold the main job to what it promises: `python .ci/check_bench.py bench.json`. Times belong to the machine."""

import itertools
import json
import sys
from pathlib import Path
from statistics import mean

POSITION_RMSE_M = 0.015
MODELS, TRAJECTORIES, SEEDS = ("mbm", "sm", "ssm"), ("circle", "square", "s", "cane"), range(5)

runs = [run for run in json.loads(Path(sys.argv[1]).read_text())["runs"] if run["horizon"] == 30]
found = {(run["model"], run["trajectory"], run["seed"]) for run in runs}
complaints = [f"{case} is missing" for case in itertools.product(MODELS, TRAJECTORIES, SEEDS) if case not in found]
for run in runs:
    case = f"{run['model']} {run['trajectory']} {run['seed']}"
    if not run["completed"]:
        complaints.append(f"{case}: not completed")
    if run["fallbacks"]:
        complaints.append(f"{case}: {run['fallbacks']} fallbacks")
    if run["model"] in MODELS and run["in_band_percent"] < 100.0:
        complaints.append(f"{case}: {run['in_band_percent']:.1f} % in band")
for model in MODELS:
    rmse = mean([run["position_rmse_m"] for run in runs if run["model"] == model] or [float("nan")])
    print(f"{model}: position RMSE {rmse:.4f} m, mean over {len(TRAJECTORIES)} trajectories and {len(SEEDS)} seeds")
    if not rmse <= POSITION_RMSE_M:
        complaints.append(f"{model}: position RMSE {rmse:.4f} m, at most {POSITION_RMSE_M} m is promised")
if complaints:
    sys.exit("\n".join(complaints))
