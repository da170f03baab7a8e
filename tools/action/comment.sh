#!/usr/bin/env bash
# Writes the verdicts as a comment on a pull request for action.yml: one comment for each job, which later runs find by its first line and
# update. Reads SUMMARY (a Markdown file; empty when there are no verdicts), EXIT_CODE, PULL_REQUEST, GH_TOKEN and what GitHub sets. What
# cannot be written, as on pull requests from forks, is said and fails nothing.
set -uo pipefail

say() { printf '%s\n' "$*"; }
fail() {
    say "::notice::No comment was written: $1 The verdicts are in the job's summary."
    exit 0
}
case ${PULL_REQUEST:-}:${GITHUB_REPOSITORY:-} in
    *[!0-9]*:* | :*) fail "this is no pull request." ;;
    *:*/*) ;;
    *) fail "the repository is not known." ;;
esac
command -v gh >/dev/null || fail "the runner has no gh (GitHub's command line)."

job=$(printf '%s' "${GITHUB_WORKFLOW:-}/${GITHUB_JOB:-}" | tr -c 'A-Za-z0-9_/' '-')
marker="<!-- rotorwatch ${job//--/-} -->"
# Only own comments: anybody can write that line.
query='query($owner: String!, $name: String!, $number: Int!, $endCursor: String) {
  repository(owner: $owner, name: $name) { pullRequest(number: $number) { comments(first: 100, after: $endCursor) {
    nodes { databaseId viewerDidAuthor body } pageInfo { hasNextPage endCursor } } } } }'
own='.data.repository.pullRequest.comments.nodes[] | select(.viewerDidAuthor) | select(.body | startswith(env.MARKER)) | .databaseId'
found=$(MARKER=$marker gh api graphql --paginate -f query="$query" -f owner="${GITHUB_REPOSITORY%%/*}" -f name="${GITHUB_REPOSITORY#*/}" \
    -F number="$PULL_REQUEST" --jq "$own" 2>/dev/null) || fail "its comments cannot be read; the job needs the permission pull-requests: write."
comment=${found%%$'\n'*}

# Without logs there is nothing to say, unless an earlier comment says something else.
if [ -z "${SUMMARY:-}" ] && [ "${EXIT_CODE:-}" = 0 ] && [ -z "$comment" ]; then exit 0; fi

body=$(mktemp) || fail "there is no room for a temporary file."
trap 'rm -f "$body"' EXIT
{
    say "$marker"
    say "### Flight logs"
    say ""
    if [ -n "${SUMMARY:-}" ] && [ -s "$SUMMARY" ]; then
        cat "$SUMMARY"
        run="${GITHUB_SERVER_URL:-https://github.com}/$GITHUB_REPOSITORY/actions/runs/${GITHUB_RUN_ID:-}"
        say ""
        say "The pages of all logs are in the artifact of [this run]($run)."
    elif [ "${EXIT_CODE:-}" = 0 ]; then
        say "This pull request changes no flight logs any more."
    else
        say "The logs could not be diagnosed: the job's log says why."
    fi
} >"$body"

if [ -n "$comment" ]; then
    gh api --silent --method PATCH "repos/$GITHUB_REPOSITORY/issues/comments/$comment" -F "body=@$body" 2>/dev/null && exit 0
else
    gh api --silent --method POST "repos/$GITHUB_REPOSITORY/issues/$PULL_REQUEST/comments" -F "body=@$body" 2>/dev/null && exit 0
fi
fail "GitHub refused it; the job needs the permission pull-requests: write, which pull requests from forks do not have."
