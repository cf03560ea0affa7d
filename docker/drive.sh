#!/bin/bash
# The simulated robot and the node that drives it, in lock step, for a while: drive.sh [TRAJECTORY [SECONDS]]
set -eu
trajectory=${1:-circle}
diffdrive-mpc sim-robot --lock-step --trajectory "$trajectory" --duration "${2:-20}" &
robot=$!
diffdrive-mpc node --trajectory "$trajectory" --drive --ros-args -p use_sim_time:=true &
node=$!
trap 'kill -INT "$node" 2>/dev/null || true' EXIT
wait "$robot"
