"""Photos and videos as inputs: find, check, decode and select them."""
