#!/bin/sh
# Make a keystore of SROS 2 for policy.xml, and for more policies: make_keys.sh KEYSTORE [POLICY.xml ...]
# Keys hold for the ROS_DOMAIN_ID of now. They are secrets: none is ever made inside a git work tree.
set -eu
umask 077
here=$(CDPATH='' cd -- "$(dirname -- "$0")" && pwd)
if [ $# -eq 0 ]; then
    echo "error: no folder for the keys: make_keys.sh KEYSTORE [POLICY.xml ...]" >&2
    exit 2
fi
# Where it really is, also behind links and where it is not there yet.
store=$(realpath -m -- "$1")
shift
folder=$store
while [ ! -e "$folder/.git" ] && [ "$folder" != / ]; do
    folder=$(dirname -- "$folder")
done
if [ -e "$folder/.git" ]; then
    echo "error: $store is inside the git work tree $folder, where keys might be committed; choose another folder" >&2
    exit 1
fi
if ! ros2 security --help > /dev/null 2>&1; then
    echo "error: 'ros2 security' is not there; install it (ros-jazzy-sros2) and source ROS 2" >&2
    exit 1
fi
ros2 security generate_artifacts -k "$store" -p "$here/policy.xml" "$@"
echo "in each process: ROS_SECURITY_KEYSTORE=$store ROS_SECURITY_ENABLE=true ROS_SECURITY_STRATEGY=Enforce"
echo "and its enclave: --ros-args --enclave /diffdrive_mpc/node (or monitored_node, monitor, robot)"
