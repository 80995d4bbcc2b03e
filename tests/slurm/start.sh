#!/bin/bash
# A real Slurm on this machine, for tests: tests/slurm/start.sh DIR (as root; Debian: slurm-wlm, munge).
# Prints the line that its commands need, SLURM_CONF=..., once a node is idle.
set -e
DIR=$(realpath -m "$1")
HOST=$(hostname -s)
mkdir -p "$DIR/state" "$DIR/spool" /run/munge
[ -f /etc/munge/munge.key ] || { dd if=/dev/urandom of=/etc/munge/munge.key bs=1 count=1024 status=none; }
chown munge: /run/munge /etc/munge/munge.key
chmod 400 /etc/munge/munge.key
cat > "$DIR/slurm.conf" <<CONF
ClusterName=t
SlurmctldHost=$HOST
AuthType=auth/munge
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
ReturnToService=2
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
SlurmUser=root
JobRequeue=1
StateSaveLocation=$DIR/state
SlurmdSpoolDir=$DIR/spool
MailProg=/bin/true
SlurmctldPidFile=$DIR/ctld.pid
SlurmdPidFile=$DIR/d.pid
SlurmctldLogFile=$DIR/ctld.log
SlurmdLogFile=$DIR/d.log
NodeName=$HOST CPUs=2 RealMemory=${SLURM_TEST_MB:-4000} State=UNKNOWN
PartitionName=p Nodes=$HOST Default=YES MaxTime=INFINITE State=UP
CONF
export SLURM_CONF="$DIR/slurm.conf"
if ! munge -n > /dev/null 2>&1; then
    su -s /bin/sh munge -c "munged --force --pid-file=/run/munge/munged.pid"
    cp /run/munge/munged.pid "$DIR/munged.pid"
fi
slurmctld
slurmd
for _ in $(seq 120); do
    if sinfo -h -o %T 2> /dev/null | grep -q idle; then
        echo "SLURM_CONF=$SLURM_CONF"
        exit 0
    fi
    sleep 0.5
done
tail -5 "$DIR/ctld.log" "$DIR/d.log" >&2
exit 1
