#!/bin/sh
# Times the stages of a build: `begin`, then `time NAME COMMAND…` for each, then `show`, which prints one line.
file=target/stages.txt

minutes() {
    if [ "$1" -ge 60 ]; then echo "$(($1 / 60)) min $(($1 % 60)) s"; else echo "$1 s"; fi
}

case $1 in
begin)
    mkdir -p target
    date +%s >"$file"
    ;;
time)
    name=$2
    shift 2
    began=$(date +%s)
    "$@" || exit
    echo "$(($(date +%s) - began)) $name" >>"$file"
    ;;
show)
    read -r began <"$file"
    parts=$(sed 1d "$file" | while read -r seconds name; do printf ', %s %s' "$name" "$(minutes "$seconds")"; done)
    echo "built in $(minutes $(($(date +%s) - began))):${parts#,}"
    ;;
esac
