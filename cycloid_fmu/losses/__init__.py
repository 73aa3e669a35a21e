"""Friction of a drive on its bearings, solved with its balance: losses, efficiency, starting and back-driving."""
