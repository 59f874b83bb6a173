"""Arrays of numbers in files of foreign origin: npz and npy, csv, grey pictures; read in bounded memory.

Neither recordings nor results, which drivers and server read with what is here.
"""
