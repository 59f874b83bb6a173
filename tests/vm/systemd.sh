# Sourced by init.sh: files for systemd in the guest, in addition to the host's units.
touch $root/etc/.updated $root/var/.updated # otherwise it rebuilds caches as after an upgrade
[ -s $root/etc/machine-id ] || echo 0123456789abcdef0123456789abcdef >$root/etc/machine-id # otherwise: a first boot
rm -f $root/.dockerenv # otherwise systemd detects a container, as the host is one
units=$root/run/systemd/system
mkdir -p $units
# The first would empty /tmp, which may contain the tested program; the rest is not needed here.
for name in systemd-tmpfiles-setup systemd-tmpfiles-setup-dev systemd-remount-fs systemd-timesyncd systemd-update-utmp; do
    ln -s /dev/null $units/$name.service
done
cat >$units/vm.service <<UNIT
[Unit]
Description=The command that the host has left
Requires=sysinit.target dbus.socket
After=sysinit.target dbus.socket
[Service]
Type=oneshot
ExecStart=/bin/sh /run/vm/command
ExecStopPost=/bin/sh -c 'echo \$EXIT_STATUS >/run/vm/code; sync; systemctl poweroff -ff'
StandardOutput=file:/dev/ttyS0
StandardError=inherit
UNIT
