#!/bin/sh
# First program of the guest: modules, the host's files as they are, then the command that the host has left.
export PATH=/bin
/bin/busybox --install -s /bin
mkdir -p /proc /sys
mount -t proc proc /proc
mount -t sysfs sys /sys
mount -t devtmpfs dev /dev
for module in /modules/*.ko; do
    options=
    case $module in
    # Two controllers, at the speed of the boards and chips that the devices have.
    *dummy_hcd*) options="num=2 is_high_speed=0" ;;
    esac
    insmod "$module" $options || echo "vm: $module cannot be loaded"
done
echo "vm: kernel $(uname -r) is up after $(cut -d' ' -f1 /proc/uptime) s"
shared=trans=virtio,version=9p2000.L,msize=262144
mount -t 9p -o "$shared,ro,cache=loose" host /host || echo "vm: no files of the host"
mount -t tmpfs run /host/run
mkdir -p /host/run/vm /host/run/tmp
chmod 1777 /host/run/tmp
mount -t 9p -o "$shared,rw,cache=loose" vm /host/run/vm || echo "vm: no folder to leave the outcome in"
# Copied, so that they are root's: kernels of another user, as they are on the host, are not loaded.
cp -R /host/run/vm/kernels /host/run/kernels && chown -R 0:0 /host/run/kernels && chmod -R go-w /host/run/kernels
mount -t proc proc /host/proc
mount -t sysfs sys /host/sys
mount -t devtmpfs dev /host/dev
mkdir -p /host/dev/pts /host/dev/shm
mount -t devpts pts /host/dev/pts
mount -t tmpfs shm /host/dev/shm
mount -t configfs config /host/sys/kernel/config
ip link set lo up
# As on any system: programs are told of devices by udev, from its own messages.
export SYSTEMD_IGNORE_CHROOT=1
chroot /host /lib/systemd/systemd-udevd --daemon --resolve-names=never
chroot /host /bin/udevadm trigger --action=add --subsystem-match=usb
chroot /host /bin/udevadm settle
chroot /host /bin/sh /run/vm/command
echo $? >/host/run/vm/code
sync
poweroff -f
