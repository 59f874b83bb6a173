"""Haply Inverse3, Inverse3x and Minverse through the maker's Inverse Service, with JSON over a WebSocket.

`messages` decodes and encodes messages, `link` has HTTP requests and the WebSocket, `connection` finds and locks a
device, and sets its filters. `exchange_thread` exchanges messages with the service, `exchange` is the
servo's side of the block between them, and `device` the device.
"""
