#!/usr/bin/env bash
# Makes .venv with the project in it, ready to run. Usage: bash scripts/setup.sh [EXTRA ...]   (extras: bench, data, docs, export, learn, record3d, rivals, test)
# A second run does nothing, unless pyproject.toml has changed or it names a new extra.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

say() { printf 'setup: %s\n' "$*" >&2; }

# Debian packages with the shared libraries that open3d and torch load, each with a file that shows whether it is installed.
libraries=(
    libGL.so.1:libgl1 libEGL.so.1:libegl1 libX11.so.6:libx11-6
    libudev.so.1:libudev1 libusb-1.0.so.0:libusb-1.0-0 libgomp.so.1:libgomp1
)

missing() {
    local known entry
    known="$(ldconfig -p 2>/dev/null || /sbin/ldconfig -p 2>/dev/null || true)"
    for entry in "$@"; do
        grep -qF "${entry%%:*} " <<<"$known" || printf '%s ' "${entry#*:}"
    done
}

find_python() {
    local name
    for name in python3.11 python3.12 python3.13 python3; do
        if command -v "$name" >/dev/null &&
            "$name" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] < (3, 14))' 2>/dev/null; then
            printf '%s' "$name"
            return
        fi
    done
}

# Whether it can, with a reason if it cannot.
install_packages() {
    local as_root=()
    if [ "$(id -u)" -ne 0 ]; then
        as_root=(sudo)
    fi
    if command -v apt-get >/dev/null && { [ "$(id -u)" -eq 0 ] || sudo -n true 2>/dev/null; }; then
        say "installing $*"
        "${as_root[@]}" apt-get update -qq >&2 || say "apt-get update failed, trying without"
        if "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive \
            apt-get install -y -qq --no-install-recommends "$@" >/dev/null; then
            return
        fi
    fi
    say "this machine lacks: $*"
    say "to install it:   sudo apt-get update && sudo apt-get install -y $*"
    return 1
}

wanted=()
read -ra absent <<<"$(missing "${libraries[@]}")"
wanted+=("${absent[@]}")
python="$(find_python)"
if [ -z "$python" ]; then
    wanted+=(python3 python3-venv)
elif [ ! -x .venv/bin/python ] && ! "$python" -c 'import ensurepip' 2>/dev/null; then
    wanted+=("$(basename "$(readlink -f "$(command -v "$python")")")-venv")
fi
if [ "${#wanted[@]}" -gt 0 ]; then
    install_packages "${wanted[@]}" || exit 1
    python="$(find_python)"
    if [ -z "$python" ]; then
        say "Python 3.11, 3.12 or 3.13 is needed, and this system's package is older or newer"
        exit 1
    fi
fi

# The mark of a finished set-up: its inputs, then the installed extras. These stay installed.
made_from="$({ cat pyproject.toml; pwd; } | sha256sum | cut -d' ' -f1)"
known=() marked=''
if [ -x .venv/bin/sdfsim ] && [ -f .venv/.set-up ]; then
    read -r marked <.venv/.set-up || true
    read -ra known < <(tail -n +2 .venv/.set-up) || true
fi
extras="$(printf '%s\n' "${known[@]}" "$@" | sed '/^$/d' | sort -u | paste -sd, -)"
if [ "$marked" = "$made_from" ] && [ "$extras" = "$(IFS=,; printf '%s' "${known[*]}")" ]; then
    exit 0
fi

if ! .venv/bin/python -m pip --version >/dev/null 2>&1; then
    say "making .venv with $("$python" --version)"
    "$python" -m venv --clear .venv
fi

# Without an NVIDIA card, torch's CPU build saves several GB of CUDA packages; if it cannot be downloaded, any build works.
index=()
cpu_torch=https://download.pytorch.org/whl/cpu
if ! { command -v nvidia-smi >/dev/null && nvidia-smi -L >/dev/null 2>&1; } &&
    .venv/bin/python - "$cpu_torch/torch/" 2>/dev/null <<'PYTHON'; then
import sys, urllib.request
urllib.request.urlopen(sys.argv[1], timeout=5).read(1)
PYTHON
    index=(--extra-index-url "$cpu_torch")
fi

say "installing Python packages (a few minutes the first time)"
rm -f .venv/.set-up
.venv/bin/python -m pip install -qq --disable-pip-version-check "${index[@]}" \
    --config-settings editable_mode=compat --editable ".${extras:+[$extras]}"  # a path, so that type checkers find it too
# Compiles all parts of the contact step, the search for contacts, and batches.
.venv/bin/python - <<'PYTHON'
import sdfsim

many = sdfsim.Scene(model="solver")
for k in range(70):
    many.add(f"{k}", sphere={"radius": 0.1}, position=(k, 0, 0))
for scene, model in (("tower", "solver"), ("knocked_vase", "solver"), ("door", "solver"), (many, "solver"), ("tower", "gnn")):
    sdfsim.Simulator(f"samples/{scene}.yaml" if isinstance(scene, str) else scene, model).step(2)
sdfsim.Batch("samples/tower.yaml", 2).step()
PYTHON
printf '%s\n%s\n' "$made_from" "${extras//,/ }" >.venv/.set-up
say "done: $(.venv/bin/python --version), $PWD/.venv"
