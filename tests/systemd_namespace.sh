#!/bin/bash
# Becomes the init of a machine of its own, inside mount, pid, uts, ipc and cgroup namespaces (see booted.py): systemd
# as PID 1, with the units in $UNITS alone and the Python environment $PREFIX at /opt/revisitd. Every place that
# systemd writes to is private memory, /proc/sys is read-only: nothing reaches the machine that the test runs on.
set -e
mount --make-rprivate /
mount -t tmpfs -o mode=755 tmpfs /opt
mkdir /opt/revisitd /opt/units
mount --bind "$PREFIX" /opt/revisitd
cp -r "$UNITS"/. /opt/units
sed '/^revisitd:/d' /etc/passwd > /opt/passwd
sed '/^revisitd:/d' /etc/group > /opt/group
echo 'revisitd:x:61234:61234::/var/lib/revisitd:/usr/sbin/nologin' >> /opt/passwd
echo 'revisitd:x:61234:' >> /opt/group
chmod 644 /opt/passwd /opt/group
mount --bind /opt/passwd /etc/passwd
mount --bind /opt/group /etc/group
for dir in /run /var/lib /var/log /var/cache /var/tmp /srv /dev/shm /tmp; do mount -t tmpfs -o mode=755 tmpfs $dir; done
chmod 1777 /tmp /var/tmp /dev/shm
umount -R /sys/fs/cgroup 2>/dev/null || umount -l /sys/fs/cgroup
mount -t cgroup2 cgroup2 /sys/fs/cgroup
mkdir -p /run/systemd /run/lock /run/log
mount --bind /proc/sys /proc/sys
mount -o remount,bind,ro /proc/sys
export container=unshare SYSTEMD_UNIT_PATH=/opt/units
exec /lib/systemd/systemd --system --unit=test.target --show-status=no
