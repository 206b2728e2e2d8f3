#!/bin/sh
# Set everything up from a clean clone, then run one thing:  sh tests/run.sh demo | test [pytest arguments]
# Needs python3 >= 3.10 and git. Makes .venv beside this checkout's files; installs missing apt packages where it may.
set -eu
cd "$(dirname "$0")/.."
what="${1:-}"
case "$what" in
demo | test) shift ;;
*)
    echo "usage: sh tests/run.sh demo | test [pytest arguments]" >&2
    exit 2
    ;;
esac

apt_install() {
    if [ "$(id -u)" = 0 ]; then
        run=
    elif sudo -n true 2>/dev/null; then
        run=sudo
    else
        echo "Error: missing packages, and no right to install them. Run: sudo apt-get install -y $*" >&2
        exit 1
    fi
    $run apt-get update -qq && $run env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq "$@" >/dev/null
}

# Debian's python3 has venv but not the pip that a new environment needs.
python3 -c "import venv, ensurepip" 2>/dev/null || apt_install python3-venv
# psutil, which ouster-sdk pins to 5.9, has no wheel for aarch64 and is compiled there.
if [ "$(uname -m)" != x86_64 ] && ! { command -v gcc && python3-config --includes; } >/dev/null 2>&1; then
    apt_install gcc python3-dev
fi

[ -x .venv/bin/python ] || python3 -m venv .venv
echo "installing into .venv" >&2
.venv/bin/python -m pip install --quiet --disable-pip-version-check --upgrade "pip>=23.1"
.venv/bin/python -m pip install --quiet --disable-pip-version-check ".[dev]"

if [ "$what" = demo ]; then
    exec .venv/bin/revisitd demo demo
fi
exec .venv/bin/python -m pytest "$@"
