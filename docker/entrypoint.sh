#!/bin/bash
# What a shell with ROS has; then the command.
set -e
source /opt/ros/jazzy/setup.bash
source /workspace/install/setup.bash
exec "$@"
