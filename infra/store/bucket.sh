#!/bin/bash
# Makes the bucket, if it is not there:    bucket.sh NAME        at AWS_ENDPOINT_URL with AWS_ACCESS_KEY_ID and its secret.
set -euo pipefail
url="$AWS_ENDPOINT_URL/${1:?the name of a bucket}"
code=$(curl --silent --show-error --retry 5 --retry-connrefused --output /tmp/said --write-out '%{http_code}' --request PUT \
    --aws-sigv4 "aws:amz:${AWS_REGION:-us-east-1}:s3" --user "$AWS_ACCESS_KEY_ID:$AWS_SECRET_ACCESS_KEY" "$url")
case $code in
    200 | 409) echo "bucket $1" ;;
    *) echo "$url: $code $(cat /tmp/said)" >&2; exit 1 ;;
esac
