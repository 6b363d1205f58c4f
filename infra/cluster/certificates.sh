#!/bin/sh
# What a cluster's parts prove themselves by, made once and then left alone until a month before it ends:
#     certificates.sh NAME...      the names under which coordinators are reached
# $SECRETS/coordinator.pem, .key   the coordinators' certificate (for them alone)
# $SHARED/ca.pem, token            what workers and clients trust and show
# $SHARED/plat.toml                the options of whoever asks for something: plat --config $SHARED/plat.toml jobs
# The authority's key is thrown away once it has signed: there is nothing to steal, and a new certificate is a new authority.
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
