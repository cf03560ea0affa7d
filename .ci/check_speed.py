"""Check the results of the study `speed`, except times: `python .ci/check_speed.py speed.json`."""

import json
import sys
from pathlib import Path

OURS = ("ours/auto", "ours/osqp", "ours/daqp")
PEERS = ("acados", "acados/hard", "do-mpc", "casadi/ipopt", "casadi/fatrop", "casadi/sqpmethod")
TIMES = ("step_p50_s", "step_p95_s", "step_p99_s", "step_max_s")
KEYS = {"solver", "model", "horizon", *TIMES, "solver_p50_s", "iterations_p50", "closed_loop_cost"}
# A median: in transients one real-time iteration is not the converged solution.
GAP_P50 = 1e-3
COST_RATIO = 0.01

content = json.loads(Path(sys.argv[1]).read_text())
records = content["records"]
complaints = [f"{absent['solver']} is missing: {absent['reason']}" for absent in content["missing"]]
cases = {(record["model"], record["horizon"]) for record in records}
for model, horizon in sorted(cases):
    case = [record for record in records if (record["model"], record["horizon"]) == (model, horizon)]
    by_solver = {record["solver"]: record for record in case}
    complaints += [f"{model} {horizon}: no {name}" for name in (*OURS, *PEERS) if name not in by_solver]
    converged = by_solver["casadi/ipopt"]["closed_loop_cost"]
    for name, record in by_solver.items():
        where = f"{name}, {model} {horizon}"
        complaints += [f"{where}: no {key}" for key in KEYS - set(record)]
        times = [record[key] for key in TIMES]
        if not (times[0] > 0 and times == sorted(times)):
            complaints.append(f"{where}: times out of order: {times}")
        if record["unsolved"]:
            complaints.append(f"{where}: {record['unsolved']} ticks unsolved")
        if max(record["gap_v_p50"], record["gap_omega_p50"]) > GAP_P50:
            complaints.append(f"{where}: gap {record['gap_v_p50']:.1e} m/s, {record['gap_omega_p50']:.1e} rad/s")
        if abs(record["closed_loop_cost"] / converged - 1) > COST_RATIO:
            complaints.append(f"{where}: cost {record['closed_loop_cost']:.5f}, converged {converged:.5f}")
    print(f"{model}, N = {horizon}: {len(by_solver)} solvers, median gaps and costs as promised")
if not cases:
    complaints.append("no records")
if complaints:
    sys.exit("\n".join(complaints))
