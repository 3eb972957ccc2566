#!/bin/sh
# Install handtouch on a robot controller, or uninstall it:
#
#   services/install.sh [all]       the program, the systemd units, and an example deployment
#   services/install.sh program     the program only (containers)
#   services/install.sh uninstall   everything but /etc/handtouch
#
# The program is installed in a virtual environment, PREFIX/lib/handtouch, with the link PREFIX/bin/handtouch. Running the
# script again updates it; existing files in SYSCONFDIR/handtouch are kept. Packages it depends on are exactly the files
# that the lock names by their hashes.
#
#   PREFIX      /usr/local      prefix of program and units
#   SYSCONFDIR  /etc            folder of the deployments
#   DESTDIR     (empty)         prepended to both, to stage an image or a package
#   WHEEL       (this source)   handtouch wheel to install; from source, a C compiler makes it fast
#   LOCK        locks/run.lock  packages to install; empty if they come from elsewhere
#   PYTHON      python3         interpreter, 3.11 or later
#   PIP_ARGS    (empty)         further arguments of pip, e.g. --no-index --find-links /media/wheels
set -eu

here=$(cd "$(dirname "$0")" && pwd)
PREFIX=${PREFIX:-/usr/local}
SYSCONFDIR=${SYSCONFDIR:-/etc}
DESTDIR=${DESTDIR:-}
WHEEL=${WHEEL:-$here/..}
LOCK=${LOCK-$here/../locks/run.lock}
PYTHON=${PYTHON:-python3}

venv=$PREFIX/lib/handtouch
units=$PREFIX/lib/systemd/system
settings=$SYSCONFDIR/handtouch

install_program() {
  "$PYTHON" -c 'import sys; sys.exit(sys.version_info < (3, 11))' ||
    { echo "install.sh: $PYTHON is older than 3.11; set PYTHON to a later one" >&2; exit 1; }
  "$PYTHON" -m venv "$DESTDIR$venv"
  [ -z "$LOCK" ] || run_pip "$DESTDIR$venv" install --require-hashes --no-deps -r "$LOCK"
  if [ -d "$WHEEL" ]; then build_wheel; fi
  run_pip "$DESTDIR$venv" install --no-deps --force-reinstall "$WHEEL" # also the same version again, changed
  if [ -n "$DESTDIR" ]; then # scripts name the environment by its path at the time
    for script in "$DESTDIR$venv"/bin/*; do
      [ -L "$script" ] || sed -i "s|$DESTDIR$venv|$venv|g" "$script"
    done
  fi
  mkdir -p "$DESTDIR$PREFIX/bin"
  ln -sf "../lib/handtouch/bin/handtouch" "$DESTDIR$PREFIX/bin/handtouch"
}

build_wheel() { # from the source in WHEEL, with the locked build tools
  work=$(mktemp -d)
  trap 'rm -rf "$work"' EXIT
  "$PYTHON" -m venv "$work/venv"
  run_pip "$work/venv" install --require-hashes --no-deps -r "$here/../locks/build.lock"
  run_pip "$work/venv" wheel --no-deps --no-build-isolation --wheel-dir "$work" "$WHEEL"
  WHEEL=$(echo "$work"/*.whl)
}

run_pip() { # VENV COMMAND [ARGUMENT...]
  python=$1/bin/python command=$2
  shift 2
  # shellcheck disable=SC2086  # PIP_ARGS is a list of words
  "$python" -m pip "$command" --quiet --disable-pip-version-check ${PIP_ARGS:-} "$@"
}

install_services() {
  mkdir -p "$DESTDIR$units" "$DESTDIR$PREFIX/lib/sysctl.d" "$DESTDIR$PREFIX/lib/udev/rules.d" "$DESTDIR$settings"
  for unit in handtouch@.service handtouch-can@.service handtouch-node@.service; do
    sed -e "s|@VENV@|$venv|g" -e "s|@SYSCONFDIR@|$SYSCONFDIR|g" "$here/$unit" >"$DESTDIR$units/$unit"
  done
  cp "$here/sysctl.conf" "$DESTDIR$PREFIX/lib/sysctl.d/60-handtouch.conf"
  cp "$here/60-handtouch-can.rules" "$DESTDIR$PREFIX/lib/udev/rules.d/"
  cp "$here/../config/handtouch.schema.json" "$here/../config/touch_node.schema.json" "$DESTDIR$settings/"
  keep "$here/../config/utah_mit.toml" hand.toml
  keep "$here/../config/touch_node.toml" node.toml
  keep "$here/environment" environment
  keep "$here/can0.env" can0.env
}

keep() { # copy a file that the owner edits, unless it is there
  [ -e "$DESTDIR$settings/$2" ] || cp "$1" "$DESTDIR$settings/$2"
}

uninstall() {
  rm -rf "$DESTDIR$venv"
  rm -f "$DESTDIR$PREFIX/bin/handtouch" "$DESTDIR$units/handtouch@.service" "$DESTDIR$units/handtouch-can@.service" \
    "$DESTDIR$units/handtouch-node@.service" "$DESTDIR$PREFIX/lib/sysctl.d/60-handtouch.conf" \
    "$DESTDIR$PREFIX/lib/udev/rules.d/60-handtouch-can.rules"
}

reload() {
  ! on_this_machine || systemctl daemon-reload
  ! on_this_machine || systemctl try-restart systemd-sysctl.service
}

on_this_machine() { # true if the units are installed for a running systemd that we may reload
  [ -z "$DESTDIR" ] && { [ "$PREFIX" = /usr/local ] || [ "$PREFIX" = /usr ]; } &&
    [ "$(id -u)" = 0 ] && [ -d /run/systemd/system ]
}

case ${1:-all} in
all)
  install_program
  install_services
  reload
  echo "Edit $settings/hand.toml, check it with \`handtouch check\` and \`handtouch doctor\`, then:"
  echo "  systemctl enable --now handtouch-can@can0 handtouch@hand"
  ;;
program) install_program ;;
uninstall)
  if on_this_machine; then
    for unit in $(systemctl list-units --all --plain --no-legend 'handtouch@*' 'handtouch-can@*' 'handtouch-node@*' | cut -d' ' -f1); do
      systemctl disable --now "$unit"
    done
  fi
  uninstall
  reload
  echo "$settings is kept"
  ;;
*)
  sed -n '2,/^set/s/^#\( \|$\)//p' "$0"
  exit 2
  ;;
esac
