"""Profiles as bodies in STEP (ISO 10303-214), written by Open CASCADE (`pip install 'cycloid-fmu[step]'`)."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cycloid_fmu.cad.layers import MM, circles, outlines

if TYPE_CHECKING:
    from cycloid_fmu.cad.outline import Array, Points
    from cycloid_fmu.cad.profile import Profile

_FLAT = 1e-7  # bulge below which an arc is a line: its three points are collinear within a picometre


def write_step(profile: Profile, path: Path) -> None:
    """Write the disc with the holes whose radius is stated, the pins as bodies, and the pin circle as a wire."""
    from OCP.BRepBuilderAPI import BRepBuilderAPI_MakeEdge, BRepBuilderAPI_MakeFace, BRepBuilderAPI_MakeWire
    from OCP.BRepPrimAPI import BRepPrimAPI_MakeCylinder, BRepPrimAPI_MakePrism
    from OCP.GC import GC_MakeArcOfCircle
    from OCP.gp import gp_Ax2, gp_Circ, gp_Dir, gp_Pnt, gp_Vec

    width = MM * profile.pair.face_width

    def at(point: complex) -> Any:
        return gp_Pnt(point.real, point.imag, -0.5 * width)

    def ring(place: complex, radius: float, up: float = 1.0) -> Any:
        circle = gp_Circ(gp_Ax2(at(place), gp_Dir(0.0, 0.0, up)), radius)
        return BRepBuilderAPI_MakeWire(BRepBuilderAPI_MakeEdge(circle).Edge()).Wire()

    def wire(start: Points, bulges: Array) -> Any:
        end = np.roll(start, -1)
        middle = 0.5 * (start + end) - 0.5j * bulges * (end - start)
        outline = BRepBuilderAPI_MakeWire()
        for one, between, other, bulge in zip(start, middle, end, bulges, strict=True):
            if abs(bulge) < _FLAT:
                outline.Add(BRepBuilderAPI_MakeEdge(at(one), at(other)).Edge())
            else:
                outline.Add(BRepBuilderAPI_MakeEdge(GC_MakeArcOfCircle(at(one), at(between), at(other)).Value()).Edge())
        return outline.Wire()

    flank, *windows = [(start, bulge) for _, start, bulge in outlines(profile)]
    face = BRepBuilderAPI_MakeFace(wire(*flank), True)
    for start, bulge in windows:
        face.Add(wire(np.roll(start[::-1], 1), -bulge[::-1]))
    bodies: list[tuple[str, Any]] = []
    for layer, place, radius in circles(profile):
        if layer == "HOLES":
            face.Add(ring(place, radius, up=-1.0))  # clockwise, the direction of inner boundaries
        elif layer == "PINS":
            axis = gp_Ax2(at(place), gp_Dir(0.0, 0.0, 1.0))
            bodies.append((f"PINS {len(bodies)}", BRepPrimAPI_MakeCylinder(axis, radius, width, 2.0 * math.pi).Shape()))
        else:
            bodies.append(("RING", ring(place, radius)))
    disc = BRepPrimAPI_MakePrism(face.Face(), gp_Vec(0.0, 0.0, width)).Shape()
    _write([("DISC", disc), *bodies], path)


def _write(bodies: list[tuple[str, Any]], path: Path) -> None:
    """Write bodies with their names."""
    from OCP.IFSelect import IFSelect_RetDone
    from OCP.Message import Message
    from OCP.STEPCAFControl import STEPCAFControl_Writer
    from OCP.TCollection import TCollection_ExtendedString
    from OCP.TDataStd import TDataStd_Name
    from OCP.TDocStd import TDocStd_Document
    from OCP.XCAFDoc import XCAFDoc_DocumentTool

    Message.DefaultMessenger_s().ChangePrinters().Clear()  # it prints a banner for each body
    document = TDocStd_Document(TCollection_ExtendedString("XmlOcaf"))
    tool = XCAFDoc_DocumentTool.ShapeTool_s(document.Main())
    for name, body in bodies:
        TDataStd_Name.Set_s(tool.AddShape(body, False), TCollection_ExtendedString(name))
    writer = STEPCAFControl_Writer()
    writer.Transfer(document)
    if writer.Write(str(path)) != IFSelect_RetDone:
        raise OSError(f"{path.name}: Open CASCADE could not write this file")
