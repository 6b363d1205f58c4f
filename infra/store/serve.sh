#!/bin/bash
# Serves S3 on port 7480. If one of its three processes ends, the container ends and is restarted by its policy.
#     STORE_KEY, STORE_SECRET   the one user's keys
# The first start creates the disk. After an interrupted first start it is created again.
set -euo pipefail
: "${STORE_KEY:?an access key, three characters or more}" "${STORE_SECRET:?its secret, eight characters or more}"
home=/var/lib/store
export CEPH_ARGS="--no-mon-config"

make_disk() {
    rm -rf "${home:?}"/mon "$home"/osd "$home"/keyring
    mkdir -p "$home/mon" "$home/osd"
    local key=(ceph-authtool "$home/keyring" --gen-key)
    ceph-authtool --create-keyring "$home/keyring" >&2
    "${key[@]}" --name mon. --cap mon 'allow *' >&2
    "${key[@]}" --name osd.0 --cap mon 'allow profile osd' --cap osd 'allow *' >&2
    "${key[@]}" --name client.admin --cap mon 'allow *' --cap osd 'allow *' >&2
    chmod 600 "$home/keyring"
    local fsid
    fsid=$(awk '$1 == "fsid" { print $3 }' /etc/ceph/ceph.conf)
    monmaptool --create --clobber --fsid "$fsid" --addv a '[v2:127.0.0.1:3300,v1:127.0.0.1:6789]' /tmp/monmap >&2
    # With the OSD in the initial map no id has to be allocated for it, which would require Python.
    osdmaptool --clobber --createsimple 1 /tmp/osdmap >&2
    ceph-mon --mkfs --id a --fsid "$fsid" --monmap /tmp/monmap --osdmap /tmp/osdmap --keyring "$home/keyring"
    ceph-osd --mkfs --id 0 --fsid "$fsid" --monmap /tmp/monmap --osd-uuid 00000000-0000-4000-8000-000000000001
    touch "$home/made"
}

[[ -e $home/made ]] || make_disk
trap 'kill $(jobs -p) 2>/dev/null; wait' TERM INT EXIT
ceph-mon --foreground --id a &
ceph-osd --foreground --id 0 &
ready() {
    until timeout 20 radosgw-admin user info --uid plat >/dev/null 2>&1 \
        || timeout 60 radosgw-admin user create --uid plat --display-name plat --access-key "$STORE_KEY" --secret "$STORE_SECRET" >/dev/null; do
        sleep 1
    done
}
ready &
ready=$!
# Ends without waiting for the other processes.
wait -n -p ended || true
[[ $ended == "$ready" ]] || { echo "serve.sh: a part of the store ended; what it said is above" >&2; exit 1; }
radosgw --foreground --name client.admin &
# A signal also ends the wait; the trap then stops the processes.
wait -n
