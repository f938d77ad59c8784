"""Maps of the risk of landing: slopes from brightness, and pads that are chosen by them."""
