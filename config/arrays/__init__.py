"""Readers of arrays in untrusted files, in bounded memory: npz and npy, csv, grey pictures.

Contains no format of recordings or results; drivers and server read these with the functions here.
"""
