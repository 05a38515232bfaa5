#!/usr/bin/env bash
# Check whether Google Cloud is ready for vjepa2-ac; optionally log in or create a bucket. Installs nothing.
set -euo pipefail

readonly DROID="https://storage.googleapis.com/gresearch/robotics/droid/1.0.1/dataset_info.json"
readonly INSTALL="https://cloud.google.com/sdk/docs/install"

usage() {
  cat <<'TEXT'
Usage: scripts/setup_gcp.sh [--login] [--bucket NAME --project PROJECT --region REGION] [--dry-run]

Without options the script reports whether gcloud is installed, and whether DROID can be read from this machine, for
which no account is needed. It can be run again at any time.

  --login            log in with your browser (application default credentials), for buckets that are not public
  --bucket NAME      create a private bucket for checkpoints if it does not exist; needs --project and --region
  --project PROJECT  identifier of the Google Cloud project that pays for the bucket
  --region REGION    region of the bucket, such as us-central1; best the region of the training
  --dry-run          print the commands without running them
  --help             show this text

Exit status: 0 success, 1 something failed, 2 wrong options.
TEXT
}

wrong() {
  printf 'setup_gcp.sh: %s\nSee scripts/setup_gcp.sh --help\n' "$1" >&2
  exit 2
}

fail() {
  printf 'setup_gcp.sh: %s\n' "$1" >&2
  exit 1
}

# Print a command with quoting for a shell, and run it unless --dry-run is set.
run() {
  printf '+'
  printf ' %q' "$@"
  printf '\n'
  if [[ $dry_run == no ]]; then
    "$@"
  fi
}

parse() {
  while (($#)); do
    case "$1" in
      --login) login=yes ;;
      --dry-run) dry_run=yes ;;
      --help | -h)
        usage
        exit 0
        ;;
      --bucket | --project | --region)
        if (($# < 2)) || [[ -z $2 || $2 == --* ]]; then
          wrong "$1 needs a value"
        fi
        printf -v "${1#--}" '%s' "$2"
        shift
        ;;
      *) wrong "unknown option: $1" ;;
    esac
    shift
  done
}

check_options() {
  local given="${bucket:+b}${project:+p}${region:+r}"
  [[ -z $given || $given == bpr ]] || wrong "--bucket, --project and --region belong together"
  [[ -n $given ]] || return 0
  [[ $bucket =~ ^[a-z0-9][a-z0-9._-]{1,61}[a-z0-9]$ ]] ||
    wrong "--bucket $bucket: invalid. Expected 3 to 63 lower-case letters, digits, '-', '_' and '.', without gs://."
  [[ $project =~ ^[a-z][a-z0-9.:-]{4,}[a-z0-9]$ ]] ||
    wrong "--project $project: invalid. Expected the project's identifier, such as my-project-123."
  [[ $region =~ ^[A-Za-z]+[A-Za-z0-9-]*$ ]] || wrong "--region $region: invalid. Expected a region such as us-central1 or EU."
}

check_gcloud() {
  if command -v gcloud >/dev/null; then
    printf 'gcloud is installed: %s\n' "$(command -v gcloud)"
  elif [[ $dry_run == yes ]]; then
    printf 'gcloud is not installed; a dry run does not need it. To install it, see %s\n' "$INSTALL"
  elif [[ $login == yes || -n $bucket ]]; then
    fail "gcloud is not installed, and --login and --bucket need it. To install it, see $INSTALL"
  else
    printf 'gcloud is not installed; only --login and --bucket need it. To install it, see %s\n' "$INSTALL"
  fi
}

log_in() {
  run gcloud auth application-default login || fail "the login did not succeed"
}

check_droid() {
  [[ $dry_run == yes ]] || command -v curl >/dev/null || fail "curl is not installed, and is needed to check access to DROID"
  run curl --head --fail --silent --show-error --location --max-time 30 --output /dev/null "$DROID" ||
    fail "DROID cannot be read from this machine. Check the network and its proxy."
  [[ $dry_run == yes ]] || printf 'DROID can be read, without an account.\n'
}

create_bucket() {
  local location answer
  local list=(gcloud storage buckets list "--project=$project" "--filter=name=$bucket" "--format=value(location)")
  local create=(gcloud storage buckets create "gs://$bucket" "--project=$project" "--location=$region"
    --uniform-bucket-level-access --public-access-prevention)
  if [[ $dry_run == yes ]]; then
    run "${list[@]}"
    run "${create[@]}"
    return
  fi
  location=$("${list[@]}") || fail "the buckets of project $project cannot be listed (see above): check --project, or log in with: gcloud auth login"
  if [[ -n $location ]]; then
    printf 'gs://%s exists already, in %s.\n' "$bucket" "$location"
    [[ ${location,,} == "${region,,}" ]] || printf 'The region of a bucket cannot be changed to %s.\n' "$region"
  elif answer=$(run "${create[@]}" 2>&1); then
    printf '%s\ngs://%s was created, private, in %s.\n' "$answer" "$bucket" "$region"
  elif [[ $answer == *409* ]]; then
    fail "gs://$bucket exists in another project, of yours or of someone else. Choose another name."
  else
    fail "gs://$bucket could not be created:
$answer"
  fi
}

login=no dry_run=no bucket="" project="" region=""
parse "$@"
check_options
check_gcloud
[[ $login == no ]] || log_in
check_droid
[[ -z $bucket ]] || create_bucket
