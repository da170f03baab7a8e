#!/usr/bin/env bash
# Assesses logs for action.yml. Reads LOGS, VEHICLE, BASELINE, FAIL_ON, REPORTS and BASE_SHA from the environment; writes pages and
# verdicts.jsonl and summary.md into REPORTS, the latter also into the job's summary, and leaves with 1 when FAIL_ON says so, with 2 after an error.
set -uo pipefail

say() { printf '%s\n' "$*"; }
reports=${REPORTS:-rotorwatch-reports}
fail_on=${FAIL_ON:-fault}
case $fail_on in
    fault | undecided | never) ;;
    *) say "::error::fail-on is '$fail_on': write fault, undecided or never."; exit 2 ;;
esac

logs=()
if [ -n "${LOGS:-}" ]; then
    while IFS= read -r line; do
        [ -n "$line" ] && logs+=("$line")
    done <<<"$LOGS"
elif [ -n "${BASE_SHA:-}" ]; then
    list=$(mktemp) || exit 2
    trap 'rm -f "$list"' EXIT
    python "$(dirname "${BASH_SOURCE[0]}")/changed.py" "$BASE_SHA" "$list" || exit 2
    while IFS= read -r -d '' file; do logs+=("$file"); done <"$list"
    if [ ${#logs[@]} -eq 0 ]; then
        say "This pull request changes no flight logs."
        [ -n "${GITHUB_OUTPUT:-}" ] && say "exit-code=0" >>"$GITHUB_OUTPUT"
        exit 0
    fi
else
    say "::error::No logs are named: give the input 'logs', or run on pull_request."
    exit 2
fi

options=()
[ -n "${VEHICLE:-}" ] && options+=(--vehicle "$VEHICLE")
while IFS= read -r line; do
    [ -n "$line" ] && options+=(--baseline "$line")
done <<<"${BASELINE:-}"

# A pull request may hold a link of that name, which would send the reports elsewhere.
if ! python -I - "$reports" <<'PYTHON'
import sys
from pathlib import Path

folder = Path(sys.argv[1])
above = () if folder.is_absolute() else folder.parents
sys.exit(any(path.is_symlink() for path in (folder, *above, *folder.rglob("*"))))
PYTHON
then
    say "::error::reports is '$reports', where there is a symbolic link: name a folder that the checkout does not hold."
    exit 2
fi
mkdir -p "$reports"
rm -f "$reports/verdicts.jsonl" "$reports/summary.md"
# What is printed about a stranger's files is no command to the runner.
quiet=$(python -I -c 'import secrets; print(secrets.token_hex(16))')
say "::stop-commands::$quiet"
rotorwatch diagnose --jsonl --out "$reports/verdicts.jsonl" --html "$reports" --markdown - ${options[@]+"${options[@]}"} \
    -- "${logs[@]}" >"$reports/summary.md"
code=$?
[ -n "${GITHUB_STEP_SUMMARY:-}" ] || cat "$reports/summary.md"
say "::$quiet::"

if [ -n "${GITHUB_OUTPUT:-}" ]; then
    say "verdicts=$reports/verdicts.jsonl" >>"$GITHUB_OUTPUT"
    say "exit-code=$code" >>"$GITHUB_OUTPUT"
    [ -s "$reports/summary.md" ] && say "summary=$reports/summary.md" >>"$GITHUB_OUTPUT"
fi
if [ -s "$reports/summary.md" ] && [ -n "${GITHUB_STEP_SUMMARY:-}" ]; then
    { say "## Flight logs"; say ""; cat "$reports/summary.md"; } >>"$GITHUB_STEP_SUMMARY"
fi

case $fail_on:$code in
    *:2) exit 2 ;;
    fault:1 | undecided:1 | undecided:3) exit 1 ;;
    *:0 | *:1 | *:3) exit 0 ;;
    *) exit 2 ;;
esac
