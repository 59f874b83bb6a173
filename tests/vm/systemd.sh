# Read by init.sh: what systemd finds in the guest beside the host's own units.
touch $root/etc/.updated $root/var/.updated # else, as after an upgrade, it would build anew what the host has
[ -s $root/etc/machine-id ] || echo 0123456789abcdef0123456789abcdef >$root/etc/machine-id # else: a first boot
rm -f $root/.dockerenv # else systemd takes the guest for the container that the host is
units=$root/run/systemd/system
mkdir -p $units
# Would empty /tmp, where the host may have the program that is tested; others have nothing to do here.
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
