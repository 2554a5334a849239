"""The speed study."""
