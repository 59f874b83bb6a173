"""3D Systems' devices (Touch, Touch X; PHANToM Omni, Desktop, Premium) through the maker's own library, found at run
time.

`models` says what each device can do, `library` finds and declares the maker's functions, `scheduler` is the library's
one thread, `exchange` is what that thread and the servo loop call, `device` opens, calibrates, stops and closes.

Nothing of the maker's is in here: its library is looked for when a device is opened, and may be absent.
"""
