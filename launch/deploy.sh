#!/bin/sh
# Run the task of a cell file on its arm: launch/deploy.sh control/cell/examples/fr3_two_minis.toml [--execute]
set -eu
root=$(cd "$(dirname "$0")/.." && pwd)
if [ -x "$root/.venv/bin/touchgoal" ]; then
  exec "$root/.venv/bin/touchgoal" deploy "$@"
elif command -v touchgoal >/dev/null; then
  exec touchgoal deploy "$@"
fi
echo "touchgoal is not set up: (cd $root && make setup), or pip install it" >&2
exit 1
