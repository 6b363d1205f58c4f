#!/bin/bash
# Creates a bucket if it does not exist:    bucket.sh NAME        at AWS_ENDPOINT_URL with AWS_ACCESS_KEY_ID and its secret.
set -euo pipefail
path="/${1:?the name of a bucket}"
# S3's signature version 2, which a shell script can compute.
date=$(LC_ALL=C date --utc --rfc-email)
signature=$(printf 'PUT\n\n\n%s\n%s' "$date" "$path" | openssl dgst -sha1 -hmac "$AWS_SECRET_ACCESS_KEY" -binary | base64)
code=$(curl --silent --show-error --retry 5 --retry-connrefused --output /tmp/said --write-out '%{http_code}' --request PUT \
    --header "Date: $date" --header "Authorization: AWS $AWS_ACCESS_KEY_ID:$signature" "$AWS_ENDPOINT_URL$path")
case $code in
    200 | 409) echo "bucket $1" ;;
    *) echo "$AWS_ENDPOINT_URL$path: $code $(cat /tmp/said)" >&2; exit 1 ;;
esac
