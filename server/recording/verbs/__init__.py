"""Verbs of the command line for recordings: record from the wire, summarize, export and replay.

Contains no file formats: these are in the parent folder.
"""
