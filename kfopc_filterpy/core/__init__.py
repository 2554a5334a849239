"""The core in C99: its sources, how they are compiled, and the library that is loaded."""
