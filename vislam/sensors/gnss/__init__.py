"""Fixes of satellite receivers, as NMEA and UBX give them, and the readings they make."""

from vislam.sensors.gnss.fixes import FIX_KINDS, Fix, FixReadings, GnssSettings
from vislam.sensors.gnss.nmea import NmeaFixes
from vislam.sensors.gnss.ubx import UbxFixes

__all__ = ["FIX_KINDS", "Fix", "FixReadings", "GnssSettings", "NmeaFixes", "UbxFixes"]
