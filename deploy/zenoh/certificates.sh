#!/usr/bin/env bash
# Makes the certificates for a stream between machines: certificates.sh FOLDER [HOST ...]
#
# FOLDER receives ca.pem and ca.key (your own certificate authority) and the certificates that it
# signs: learner, worker and monitor, each as .pem and .key.  HOST: every name or address under which
# workers and monitors reach the learner; this machine's loopback is always included.
#
# Run it again with the same FOLDER for new certificates from the same authority.
# DAYS=n sets their validity in days (365).
set -euo pipefail
umask 077

if [[ $# -lt 1 || $1 == -* ]]; then
    sed -n '2,9s/^# \{0,1\}//p' "$0" >&2
    exit 2
fi
folder=$1
shift
days=${DAYS:-365}
mkdir -p "$folder"
cd "$folder"

names="DNS:localhost,IP:127.0.0.1,IP:::1"
for host in "$@"; do
    # An IPv6 address has colons, an IPv4 address only digits and dots; anything else is a name.
    if [[ $host == *:* || $host =~ ^[0-9.]+$ ]]; then names+=",IP:$host"; else names+=",DNS:$host"; fi
done

make() { # FILE DAYS COMMON-NAME EXTENSIONS... -- SIGNING OPTIONS: writes FILE.key and FILE.pem, each in one step
    local file=$1 days=$2 name=$3 extensions=()
    shift 3
    while [[ $1 != -- ]]; do
        extensions+=("$1")
        shift
    done
    shift
    openssl genpkey -algorithm EC -pkeyopt ec_paramgen_curve:P-256 -out "$file.key.new"
    openssl req -new -key "$file.key.new" -subj "/O=icrl-dist/CN=$name" |
        openssl x509 -req -sha256 -days "$days" -set_serial "0x$(openssl rand -hex 16)" -out "$file.pem.new" "$@" \
            -extfile <(printf '%s\n' "${extensions[@]}")
    mv "$file.key.new" "$file.key"
    mv "$file.pem.new" "$file.pem"
}

if [[ ! -e ca.key ]]; then
    make ca 3650 "icrl-dist $(openssl rand -hex 4)" "basicConstraints=critical,CA:TRUE,pathlen:0" \
        "keyUsage=critical,keyCertSign,cRLSign" "subjectKeyIdentifier=hash" -- -signkey ca.key.new
fi

issue() { # ROLE EXTENSIONS...: the common name is the role, which decides what the learner allows a client
    make "$1" "$days" "$1" "basicConstraints=critical,CA:FALSE" "keyUsage=critical,digitalSignature" \
        "subjectKeyIdentifier=hash" "authorityKeyIdentifier=keyid" "${@:2}" -- -CA ca.pem -CAkey ca.key
}
# Each is valid for one side of a connection only, so that a worker's certificate cannot be used as a learner's.
issue learner "extendedKeyUsage=serverAuth" "subjectAltName=$names"
issue worker "extendedKeyUsage=clientAuth"
issue monitor "extendedKeyUsage=clientAuth"

echo "in $folder, valid for $days days, for a learner at $names:"
echo "  learner.pem learner.key ca.pem   to the learner's node"
echo "  worker.pem  worker.key  ca.pem   to every worker's node"
echo "  monitor.pem monitor.key ca.pem   to everybody who may watch"
echo "  ca.key                           keep it secret: it signs new certificates"
