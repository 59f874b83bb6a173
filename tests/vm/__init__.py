"""Drivers on the USB and HID of a real kernel, in a virtual machine that needs no privilege: `make test-vm`.

On this machine: `run` boots the `kernel` that apt names with an `initramfs`; `init.sh` is the first program of the
guest. In the guest: `gadgets` are the devices, on_*.py the tests.
"""
