"""The filters: one file a method, all of the shape that `methods/_protocol.py` declares."""
