# Sourced by tools/demo, tools/test and tools/lint: `use_environment EXTRAS` makes sure that a virtual
# environment holds qgs, its EXTRAS and the plugins, and puts it first on PATH.

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)

die() {
    printf 'qgs: %s\n' "$@" >&2
    exit 1
}

is_new_enough() {
    "$1" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null
}

find_python() {
    local candidate
    for candidate in python3 python3.14 python3.13 python3.12 python3.11; do
        if is_new_enough "$candidate"; then
            echo "$candidate"
            return
        fi
    done
    die "Python 3.11 or newer is needed, found $(python3 --version 2>&1 || true)." \
        "On Debian or Ubuntu: sudo apt install python3.11 python3.11-venv"
}

has_stamp() {
    compgen -G "$1/.qgs-*" >/dev/null
}

# A folder that this script did not make is never touched; the stamp is there from the first moment,
# so that an interrupted attempt can be repeated.
make_environment() {
    local directory=$1 python
    if [[ -e $directory ]] && ! has_stamp "$directory"; then
        die "$directory is in the way: it has no working Python 3.11 with pip, and qgs did not make it." \
            "Activate the environment that you want to use, or move $directory away."
    fi
    python=$(find_python)
    "$python" -c 'import ensurepip, venv' 2>/dev/null ||
        die "$python cannot make virtual environments: its venv module is missing." \
            "On Debian or Ubuntu: sudo apt install python3-venv"
    echo "qgs: making the virtual environment $directory" >&2
    rm -rf "$directory"
    mkdir -p "$directory"
    touch "$directory/.qgs-made"
    "$python" -m venv "$directory" || die "$directory could not be made (see above)."
}

# What an installation depends on; any change of it installs again.
fingerprint() {
    {
        echo "$root"
        "$1/bin/python" --version
        cat "$root"/{pyproject.toml,constraints.txt,plugins/*/pyproject.toml}
    } | sha256sum | cut -d' ' -f1
}

install() {
    local environment=$1 extras=$2 wanted=$3 started=$SECONDS extra
    "$environment/bin/python" -m pip --version >/dev/null 2>&1 ||
        die "the virtual environment $environment has no pip." \
            "Add it with: $environment/bin/python -m ensurepip"
    local plugin packages=(--editable "$root${extras:+[$extras]}")
    if ! is_installed "$environment" "$wanted" plugins; then
        for plugin in "$root"/plugins/[a-z]*/; do
            packages+=(--editable "$plugin")
        done
    fi
    echo "qgs: installing query-gaussians[$extras] into $environment, with $((${#packages[@]} / 2 - 1))" \
        "plugins; the first time takes some minutes" >&2
    # One build backend for all distributions, where pip would make an environment for each. Modules
    # are compiled when first imported: most of them never are.
    local pip=("$environment/bin/python" -m pip install --disable-pip-version-check --no-compile
        --constraint "$root/constraints.txt")
    { "${pip[@]}" --quiet hatchling editables && "${pip[@]}" --no-build-isolation "${packages[@]}"; } >&2 ||
        die "the installation failed (see above); run the command again to retry."
    for extra in ${extras//,/ } plugins; do
        echo "$wanted" >"$environment/.qgs-$extra"
    done
    echo "qgs: installed in $((SECONDS - started)) s" >&2
}

is_installed() {
    local environment=$1 wanted=$2 extra
    for extra in ${3//,/ }; do
        [[ -f $environment/.qgs-$extra && $(<"$environment/.qgs-$extra") == "$wanted" ]] || return 1
    done
}

use_environment() {
    local extras=${1:-} environment=${VIRTUAL_ENV:-$root/.venv} wanted
    if [[ -n ${VIRTUAL_ENV:-} ]]; then
        is_new_enough "$environment/bin/python" ||
            die "the active virtual environment $environment has no Python 3.11 or newer." \
                "Deactivate it and run the command again."
    elif ! is_new_enough "$environment/bin/python" || [[ ! -x $environment/bin/pip ]]; then
        make_environment "$environment"
    fi
    wanted=$(fingerprint "$environment")
    if ! is_installed "$environment" "$wanted" "$extras,plugins"; then
        install "$environment" "$extras" "$wanted"
    fi
    export VIRTUAL_ENV=$environment PATH="$environment/bin:$PATH"
}
