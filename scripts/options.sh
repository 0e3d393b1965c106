# shellcheck shell=bash
# SPDX-License-Identifier: Apache-2.0
# How scripts read their arguments. Source it.

refuse() { # with a line that says why
    echo "error: $*" >&2
    exit 2
}
value() { # of the option that the arguments begin with
    [ $# -gt 1 ] || refuse "$1 needs a value"
    echo "$2"
}
