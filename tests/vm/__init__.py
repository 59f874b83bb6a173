"""The drivers on a true kernel's USB and HID, in a virtual machine that needs no privilege: `make test-vm`.

On this machine: `run` boots, with the `kernel` that apt names and the `initramfs` made of it; `init.sh` is the first
program of the guest. In the guest: `gadgets` are the devices, on_*.py the tests.
"""
