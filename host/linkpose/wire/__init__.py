"""The wire: frames, messages, decoders. Imports nothing above itself."""
