#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Builds the site of docs/, and fails at a broken link or a docstring that cannot be read.
set -eu -o pipefail
usage() {
    cat <<'USAGE'
usage: bash scripts/docs.sh [--serve]

Builds docs/ and the API of the docstrings into site/; open site/index.html. The sources are read,
not imported, so that it needs neither ROS nor the packages: only .venv-docs, which it makes.

  --serve    shows the pages at http://127.0.0.1:8000 while you change them
USAGE
}
case "${1:-}" in
-h | --help) usage; exit 0 ;;
'') build=(build --clean) ;;
--serve) build=(serve) ;;
*) echo "error: unknown option '$1'; see --help" >&2; exit 2 ;;
esac
cd "$(dirname "$0")/.."
venv=.venv-docs python="${PYTHON:-python3}"
unset PYTHONPATH # of a ROS that is sourced
wanted="$(cat requirements/docs.txt; "$python" --version)"
if [ "$(cat "$venv/.installed" 2>/dev/null)" != "$wanted" ]; then
    echo "docs: installing MkDocs into $venv" >&2
    "$python" -m venv --clear "$venv"
    "$venv/bin/python" -m pip install --quiet --disable-pip-version-check -r requirements/docs.txt
    printf '%s' "$wanted" >"$venv/.installed"
fi
export NO_MKDOCS_2_WARNING=1
# Not --quiet: it would also hide the warnings from --strict.
"$venv/bin/mkdocs" "${build[@]}" --strict 2>&1 | sed -u '/^INFO.* \(Building\|Cleaning\|Doc\)/d' >&2
[ "${build[0]}" = serve ] || echo "docs: site/index.html"
