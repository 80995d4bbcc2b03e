#!/bin/bash
# Ends the Slurm that tests/slurm/start.sh DIR started, by the pids that it left there.
DIR=$(realpath -m "$1")
for file in d ctld munged; do
    [ -f "$DIR/$file.pid" ] && kill "$(cat "$DIR/$file.pid")" 2> /dev/null
done
exit 0
