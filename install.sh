#!/usr/bin/env bash
# Make .venv with a Python 3.12 found on this machine and install the locked workspace into it.
set -euo pipefail
cd "$(dirname "$0")"

# A version manager's shim may answer to `python3.12` and yet run nothing: ask each candidate.
find_python() {
  local candidate
  for candidate in "${PYTHON:-}" python3.12 python3 "$HOME"/.pyenv/versions/3.12*/bin/python; do
    [ -n "$candidate" ] || continue
    if "$candidate" -c 'import sys; sys.exit(sys.version_info[:2] != (3, 12))' 2>/dev/null; then
      echo "$candidate"
      return
    fi
  done
  echo "install: error: no Python 3.12 found (lerobot needs it); install it or set PYTHON=/path/to/python3.12" >&2
  exit 5
}

if [ ! -x .venv/bin/python ]; then
  python=$(find_python)
  "$python" -m venv .venv
fi
.venv/bin/python -m pip install --quiet --disable-pip-version-check "uv>=0.8"
# --inexact keeps other packages, such as tasks that a user has installed.
VIRTUAL_ENV="$PWD/.venv" .venv/bin/uv sync --active --locked --inexact --quiet
