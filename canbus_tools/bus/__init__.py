"""The bus as tools use it: opening, frames, load, talking to a node by the project's link."""
