"""Decoding of photos: untrusted files, colour profiles, 16 bits, a cache with decoding ahead."""
