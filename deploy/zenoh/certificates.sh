#!/usr/bin/env bash
# Makes what the stream needs to leave this machine: certificates.sh FOLDER [HOST ...]
#
# FOLDER gets ca.pem and ca.key (a certificate authority of your own) and, made with it,
# learner, worker and monitor, each a .pem and a .key.  HOST is every name or address under which
# workers and monitors reach the learner; this machine's loopback is always among them.
#
# Run it again with the same FOLDER and it makes new certificates with the same authority.
# DAYS=n says how long they are good for (365).
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

make() { # FILE DAYS COMMON-NAME EXTENSIONS... -- HOW TO SIGN: FILE.key and FILE.pem, whole or not at all
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

issue() { # ROLE EXTENSIONS...: the role is the common name, by which the learner tells what a client may do
    make "$1" "$days" "$1" "basicConstraints=critical,CA:FALSE" "keyUsage=critical,digitalSignature" \
        "subjectKeyIdentifier=hash" "authorityKeyIdentifier=keyid" "${@:2}" -- -CA ca.pem -CAkey ca.key
}
# Each is for one side of a connection only: a worker's certificate must not pass for the learner's.
issue learner "extendedKeyUsage=serverAuth" "subjectAltName=$names"
issue worker "extendedKeyUsage=clientAuth"
issue monitor "extendedKeyUsage=clientAuth"

echo "in $folder, good for $days days, for a learner at $names:"
echo "  learner.pem learner.key ca.pem   to the learner's machine"
echo "  worker.pem  worker.key  ca.pem   to every worker's machine"
echo "  monitor.pem monitor.key ca.pem   to whoever may watch"
echo "  ca.key                           to nobody: who has it can make more"
