#!/usr/bin/env bash
# Runs on a machine with a GPU, in ten minutes, what a CPU cannot hold, and writes a report as it goes:
#     tools/gpu_check.sh WHEELS [OUT [WORD ...]]      (OUT: a new folder, gpu-report if not given;
#                                                     WORDs: of the steps' names, all if not given)
# The machine needs Python 3.11 or newer with pip, torch with CUDA, and nvcc (gsplat compiles), and no
# network. WHEELS is a folder with the wheels of all else, filled where there is a network, for the
# Python of that machine (here 3.12), by
#     pip download --only-binary=:all: --python-version 3.12 --implementation cp \
#         --platform manylinux_2_28_x86_64 --platform manylinux_2_17_x86_64 --platform manylinux2014_x86_64 \
#         --no-deps -d WHEELS -r <(pip freeze --exclude-editable | grep -v ^torch) \
#         gsplat==1.5.3 jaxtyping wadler-lindig ninja hatchling editables trove-classifiers
# Exit code: 0 all steps passed, 1 some failed (the report says which), 2 there is no GPU, 124 time was up (the
# report lacks the steps that did not end).
set -uo pipefail
root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
python=${PYTHON:-python3}
if (($# < 1)) || [[ ! -d $1 ]]; then
    echo "gpu_check: usage: tools/gpu_check.sh WHEELS [OUT]; WHEELS must be a folder, got '${1:-nothing}'" >&2
    exit 64
fi
wheels=$(cd "$1" && pwd)
out=${2:-gpu-report}
if ! "$python" -c 'import sys, torch; sys.exit(0 if torch.cuda.is_available() else 2)'; then
    echo "gpu_check: $python finds no GPU: torch is missing, has no CUDA, or there is no device" >&2
    exit 2
fi
if [[ -e $out ]]; then
    echo "gpu_check: $out exists; name a new folder for the report" >&2
    exit 64
fi
mkdir -p "$out"
out=$(cd "$out" && pwd)
environment=$out/environment
# It sees the packages of $python, which may itself be of an environment.
"$python" -m venv --without-pip "$environment" || exit 1
"$python" -c 'import site; print(*site.getsitepackages(), site.getusersitepackages(), sep="\n")' \
    >"$("$environment/bin/python" -c 'import site; print(site.getsitepackages()[0])')/outer.pth"
plugins=()
for plugin in "$root"/plugins/[a-z]*/; do
    plugins+=(--editable "$plugin")
done
# torch stays the machine's: wheels of it in WHEELS are not looked at.
mapfile -t files < <(find "$wheels" -type f -name '*.whl' ! -name 'torch-*' ! -name 'nvidia_*' ! -name 'triton-*')
install=("$python" -m pip --python "$environment/bin/python" install -q --no-index)
install+=(--disable-pip-version-check --no-deps)
"${install[@]}" "${files[@]}" || echo "gpu_check: some wheels could not be installed (see above)" >&2
"${install[@]}" --no-build-isolation --editable "$root" "${plugins[@]}" || {
    echo "gpu_check: qgs could not be installed (see above); WHEELS must have hatchling" >&2
    exit 1
}
export PATH="$environment/bin:$PATH"
# Compiled code is kept for the next run with this torch.
cache=$root/build/$("$python" -c 'import sys, torch; print(f"{sys.version_info.minor}-{torch.__version__}")')
export TORCH_EXTENSIONS_DIR=$cache/extensions TORCHINDUCTOR_CACHE_DIR=$cache/inductor TRITON_CACHE_DIR=$cache/triton
export PYTHONUNBUFFERED=1
cd "$root" && exec timeout $((570 - SECONDS)) "$environment/bin/python" tools/gpu_check.py "$out" "${@:3}"
