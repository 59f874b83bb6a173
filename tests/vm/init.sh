#!/bin/sh
# First program of the guest: load modules, mount the host's files read-only, run the host's command. With
# softfinger.systemd on the kernel's command line, systemd runs instead, with a writable layer in memory above them.
export PATH=/bin
/bin/busybox --install -s /bin
mkdir -p /proc /sys
mount -t proc proc /proc
mount -t sysfs sys /sys
mount -t devtmpfs dev /dev
for module in /modules/*.ko; do
    options=
    case $module in
    # Two controllers, at the speed of the devices' boards and chips.
    *dummy_hcd*) options="num=2 is_high_speed=0" ;;
    esac
    insmod "$module" $options || echo "vm: $module cannot be loaded"
done
echo "vm: kernel $(uname -r) is up after $(cut -d' ' -f1 /proc/uptime) s"
shared=trans=virtio,version=9p2000.L,msize=262144
mount -t 9p -o "$shared,ro,cache=loose" host /host || echo "vm: no files of the host"
root=/host
if grep -q softfinger.systemd /proc/cmdline; then
    root=/system
    mount -t tmpfs above /above
    mkdir /above/files /above/work
    mount -t overlay -o lowerdir=/host,upperdir=/above/files,workdir=/above/work overlay $root || echo "vm: no overlay"
fi
mount -t tmpfs run $root/run
mkdir -p $root/run/vm $root/run/tmp
chmod 1777 $root/run/tmp
mount -t 9p -o "$shared,rw,cache=loose" vm $root/run/vm || echo "vm: no folder to leave the outcome in"
# Copied, so that root owns them: kernels of another user, as on the host, are not loaded.
cp -R $root/run/vm/kernels $root/run/kernels && chown -R 0:0 $root/run/kernels && chmod -R go-w $root/run/kernels
mount -t proc proc $root/proc
mount -t sysfs sys $root/sys
mount -t devtmpfs dev $root/dev
mkdir -p $root/dev/pts $root/dev/shm
mount -t devpts pts $root/dev/pts
mount -t tmpfs shm $root/dev/shm
mount -t configfs config $root/sys/kernel/config
ip link set lo up
if [ $root = /system ]; then
    mkdir $root/run/above $root/run/below # for a test: files written, and files of the host
    mount -o bind /above $root/run/above
    mount -o bind /host $root/run/below
    . /systemd.sh
    exec switch_root $root /lib/systemd/systemd
fi
# As on any system, udev notifies programs of devices.
export SYSTEMD_IGNORE_CHROOT=1
chroot /host /lib/systemd/systemd-udevd --daemon --resolve-names=never
chroot /host /bin/udevadm trigger --action=add --subsystem-match=usb
chroot /host /bin/udevadm settle
chroot /host /bin/sh /run/vm/command
echo $? >/host/run/vm/code
sync
poweroff -f
