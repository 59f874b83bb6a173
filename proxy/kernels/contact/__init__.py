"""The proxy: what it meets, which constraints hold it, how it is carried along and rolls.

How hard friction resists is not said here, but in `friction`.
"""
