"""The controller as C99 for a microcontroller: the core's sources, with this configuration's sizes and constants."""

from diffdrive_mpc_extras.export.library import FILES, FOLDERS, ExportedLibrary, Precision, export_controller

__all__ = ["FILES", "FOLDERS", "ExportedLibrary", "Precision", "export_controller"]
