#!/bin/sh
# Sets up a clean clone: system packages where it may, a virtual environment, the project.
# Called by the Makefile with PYTHON and VENV set. Says what is missing and goes on.
set -eu

missing() { printf 'plumbline: %s\n' "$1" >&2; }

apt_install() {
    command -v apt-get >/dev/null 2>&1 || return 1
    if [ "$(id -u)" = 0 ]; then as_root=""; elif sudo -n true 2>/dev/null; then as_root="sudo"; else return 1; fi
    [ -n "${updated:-}" ] || $as_root apt-get update -qq >/dev/null 2>&1 || true
    updated=yes
    DEBIAN_FRONTEND=noninteractive $as_root apt-get install -y -qq "$@" >/dev/null 2>&1
}

if ! command -v dot >/dev/null 2>&1; then
    apt_install graphviz || missing "Graphviz's dot is not here: wiring is exported as DOT text, without SVG and PNG"
fi
if ! command -v chromium >/dev/null 2>&1 && ! command -v google-chrome >/dev/null 2>&1; then
    apt_install chromium || missing "Chromium is not here: the test that opens the report in a browser is skipped"
fi

if ! "$PYTHON" -m venv "$VENV" 2>/dev/null; then
    rm -rf "$VENV"
    apt_install python3-venv || true
    "$PYTHON" -m venv "$VENV" || {
        missing "cannot make a virtual environment with $PYTHON: install python3-venv"
        exit 1
    }
fi
"$VENV/bin/python" -m pip install --quiet --disable-pip-version-check \
    --constraint constraints.txt --editable ".[dev]"

# Machine code for the kernels is kept on disk; one flight makes all that the default scenario needs.
printf 'plumbline: compiling, once; this takes a minute or two\n'
first_flight=$(mktemp -d)
"$VENV/bin/plumbline" land --no-report --out "$first_flight" >/dev/null || [ $? -eq 1 ]
rm -rf "$first_flight"
