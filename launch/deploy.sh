#!/bin/sh
# Run the task of a cell file on its arm: launch/deploy.sh launch/cells/fr3_two_minis.toml [--execute]
set -eu
cd "$(dirname "$0")/.."
[ -x .venv/bin/touchgoal ] || { echo "set it up first: make test" >&2; exit 1; }
exec .venv/bin/touchgoal deploy "$@"
