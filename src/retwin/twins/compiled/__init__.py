"""Functions that step through time: traced once, then run in torch or as compiled C99."""
