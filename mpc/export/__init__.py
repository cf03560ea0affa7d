"""The controller as C99 for a microcontroller: sources, generated constants, OSQP's embedded code, reference tables."""

from diffdrive_mpc.mpc.export.library import FILES, FOLDERS, ExportedLibrary, Precision, export_controller

__all__ = ["FILES", "FOLDERS", "ExportedLibrary", "Precision", "export_controller"]
