"""Check the results of the main job against limits and against the last result: `check_bench.py bench.json`.

The error of a model may exceed the error in `bench_errors.json` by at most the share `WORSE`, over the same
trajectories and seeds. A commit that changes the error on purpose, or reduces it, writes the file again with `--store`:
`python .ci/check_bench.py bench.json --store`. Times are not checked, because they depend on the machine.
"""

import itertools
import json
import sys
from pathlib import Path
from statistics import mean

POSITION_RMSE_M, WORSE = 0.015, 0.03
STORE = Path(__file__).with_name("bench_errors.json")
MODELS, TRAJECTORIES, SEEDS = ("mbm", "sm", "ssm"), ("circle", "square", "s", "cane"), range(5)

runs = [run for run in json.loads(Path(sys.argv[1]).read_text())["runs"] if run["horizon"] == 30]
errors = {
    f"{run['model']} {run['trajectory']} {run['seed']}": round(run["position_rmse_m"], 6) for run in reversed(runs)
}
promised = [" ".join(map(str, case)) for case in itertools.product(MODELS, TRAJECTORIES, SEEDS)]
complaints = [f"{case} is missing" for case in promised if case not in errors]
for run in runs:
    case = f"{run['model']} {run['trajectory']} {run['seed']}"
    if not run["completed"]:
        complaints.append(f"{case}: not completed")
    if run["fallbacks"]:
        complaints.append(f"{case}: {run['fallbacks']} fallbacks")
    if run["model"] in MODELS and run["in_band_percent"] < 100.0:
        complaints.append(f"{case}: {run['in_band_percent']:.1f} % in band")
if "--store" in sys.argv:
    of_models = {case: error for case, error in errors.items() if case.split()[0] in MODELS}
    STORE.write_text(json.dumps(of_models, indent=0) + "\n")
    sys.exit()
stored = json.loads(STORE.read_text()) if STORE.is_file() else {}
for model in MODELS:
    rmse = mean([run["position_rmse_m"] for run in runs if run["model"] == model] or [float("nan")])
    print(f"{model}: position RMSE {rmse:.4f} m, mean over {len(TRAJECTORIES)} trajectories and {len(SEEDS)} seeds")
    if not rmse <= POSITION_RMSE_M:
        complaints.append(f"{model}: position RMSE {rmse:.4f} m, at most {POSITION_RMSE_M} m is the limit")
    pairs = [(errors[case], error) for case, error in stored.items() if case.split()[0] == model and case in errors]
    if not pairs:
        complaints.append(f"{model}: nothing in {STORE.name} to compare with; write it with --store")
        continue
    ratio = sum(now for now, _ in pairs) / sum(before for _, before in pairs)
    print(f"{model}: {100 * (ratio - 1):+.1f} % against {STORE.name}, {len(pairs)} pairs")
    if ratio > 1 + WORSE:
        complaints.append(
            f"{model}: {100 * (ratio - 1):.1f} % worse than {STORE.name}, at most {100 * WORSE:g} % passes; "
            "write it again with --store in this commit if this is intended"
        )
if complaints:
    sys.exit("\n".join(complaints))
