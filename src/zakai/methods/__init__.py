"""The filters, in folders by kind of state space; each method is one file of the shape that `methods/_protocol.py` declares."""
