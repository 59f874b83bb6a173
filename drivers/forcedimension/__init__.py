"""Force Dimension's devices (omega, delta, sigma, lambda) through the maker's own library, found at run time.

`models` says what each device can do, `library` finds and declares the maker's functions, `usb` sees what is attached
without it, `exchange` is what the servo loop calls, `device` opens, sets up, stops and closes.

Nothing of the maker's is in here: its library is looked for when a device is opened, and may be absent.
"""
