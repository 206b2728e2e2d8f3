#!/bin/bash
# Becomes the init of a machine of its own, inside mount, pid, uts, ipc and cgroup namespaces (see booted.py): systemd
# as PID 1, with the units in $UNITS alone. Every place that systemd writes to is private memory, /proc/sys is
# read-only: nothing reaches the machine that the test runs on.
set -e
mount --make-rprivate /
mount -t tmpfs -o mode=755 tmpfs /opt
mkdir /opt/units /opt/python /opt/sites
cp -r "$UNITS"/. /opt/units
# The tests' own Python environment, put together anew at /opt/revisitd: it may lie in a home that services do not see.
mount --bind "$PYTHON_HOME" /opt/python
/opt/python/bin/python3 -m venv --without-pip /opt/revisitd
number=0
while IFS= read -r site; do
    number=$((number + 1))
    mkdir /opt/sites/$number
    mount --bind "$site" /opt/sites/$number
    # By addsitedir, which follows the .pth files in there: an editable installation is one.
    echo "import site; site.addsitedir('/opt/sites/$number')" >> "$(echo /opt/revisitd/lib/python3*/site-packages)/tests.pth"
done <<< "$SITES"
cat > /opt/revisitd/bin/revisitd <<'END'
#!/opt/revisitd/bin/python
from revisitd.daemon.cli import main
if __name__ == "__main__":
    main()
END
chmod 755 /opt/revisitd/bin/revisitd
# Without the service and the user that this machine may have itself.
cp -a /etc /opt/etc
rm -rf /opt/etc/revisitd /opt/etc/systemd/system/revisitd*
sed -i '/^revisitd:/d' /opt/etc/passwd /opt/etc/group /opt/etc/*shadow
mount --bind /opt/etc /etc
for dir in /run /var/lib /var/log /var/cache /var/tmp /srv /dev/shm /tmp; do mount -t tmpfs -o mode=755 tmpfs $dir; done
chmod 1777 /tmp /var/tmp /dev/shm
umount -R /sys/fs/cgroup 2>/dev/null || umount -l /sys/fs/cgroup
mount -t cgroup2 cgroup2 /sys/fs/cgroup
mkdir -p /run/systemd /run/lock /run/log
mount --bind /proc/sys /proc/sys
mount -o remount,bind,ro /proc/sys
# Of the kernel's settings there is one that a test may write: a file that is none.
cp /proc/sys/net/core/rmem_max /opt/rmem_max
mount --bind /opt/rmem_max /proc/sys/net/core/rmem_max
export container=unshare SYSTEMD_UNIT_PATH=/opt/units:/etc/systemd/system
exec /lib/systemd/systemd --system --unit=test.target --show-status=no
