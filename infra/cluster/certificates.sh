#!/bin/sh
# Creates a cluster's certificates and token once, and renews them a month before they expire:
#     certificates.sh NAME...      the host names of the coordinators
# $SECRETS/coordinator.pem, .key   the coordinators' certificate and key (for them only)
# $SHARED/ca.pem, token            the authority that workers and clients trust, and their token
# $SHARED/plat.toml                the clients' options: plat --config $SHARED/plat.toml jobs
# The authority's key is deleted after signing, so that it cannot be stolen. A new certificate therefore has a new authority.
set -eu
umask 077
: "${SECRETS:=/secrets}" "${SHARED:=/cluster}" "${PLAT_STORE:?the URL of the store, under which all find who leads}"
month=2592000
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT

if ! openssl x509 -in "$SECRETS/coordinator.pem" -noout -checkend $month >/dev/null 2>&1 || ! [ -s "$SHARED/ca.pem" ]; then
    names="IP:127.0.0.1,DNS:localhost"
    for name in "$@"; do names="$names,DNS:$name"; done
    request() { openssl req -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes "$@" 2>/dev/null; }
    request -x509 -keyout "$scratch/ca.key" -out "$scratch/ca.pem" -days 825 -subj "/CN=plat cluster authority" \
        -addext "basicConstraints=critical,CA:TRUE" -addext "keyUsage=critical,keyCertSign"
    request -new -keyout "$scratch/coordinator.key" -out "$scratch/request" -subj "/CN=plat coordinator"
    printf 'subjectAltName=%s\nextendedKeyUsage=serverAuth\nbasicConstraints=critical,CA:FALSE\n' "$names" > "$scratch/extensions"
    openssl x509 -req -in "$scratch/request" -CA "$scratch/ca.pem" -CAkey "$scratch/ca.key" -CAcreateserial -days 825 \
        -extfile "$scratch/extensions" -out "$scratch/coordinator.pem" 2>/dev/null
    cp "$scratch/coordinator.pem" "$scratch/coordinator.key" "$SECRETS/"
    cp "$scratch/ca.pem" "$SHARED/"
    echo "a certificate for $names"
fi
[ -s "$SHARED/token" ] || openssl rand -hex 32 > "$SHARED/token"
printf 'coordinator = "%s"\ntls-ca = "%s"\ntoken-file = "%s"\n' "$PLAT_STORE" "$SHARED/ca.pem" "$SHARED/token" > "$SHARED/plat.toml"
