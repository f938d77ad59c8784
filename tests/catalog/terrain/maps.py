"""Small maps with labels, as ISIS, PDS3 and PDS4 write them."""

import numpy as np

ISIS_TYPES = {
    "uint8": "UnsignedByte",
    "int16": "SignedWord",
    "uint16": "UnsignedWord",
    "int32": "SignedInteger",
    "uint32": "UnsignedInteger",
    "float32": "Real",
}


def isis_cube(path, values, base=0.0, multiplier=1.0, **mapping):
    """An ISIS cube with a map projection; `mapping` replaces keywords of its group Mapping."""
    rows, cols = values.shape
    resolution = 2.0 * np.pi * 1737400.0 / cols / 4.0
    words = {
        "ProjectionName": "SimpleCylindrical",
        "TargetName": "Moon",
        "EquatorialRadius": "1737400.0 <meters>",
        "PolarRadius": "1737400.0 <meters>",
        "LatitudeType": "Planetocentric",
        "LongitudeDirection": "PositiveEast",
        "LongitudeDomain": "360",
        "CenterLongitude": "0.0",
        "UpperLeftCornerX": f"{-resolution * cols / 2.0:.6f} <meters>",
        "UpperLeftCornerY": f"{resolution * rows / 2.0:.6f} <meters>",
        "PixelResolution": f"{resolution:.9f} <meters/pixel>",
        "Scale": f"{np.pi / 180.0 * 1737400.0 / resolution:.9f} <pixels/degree>",
    } | mapping
    group = "".join(f"    {key} = {value}\n" for key, value in words.items() if value is not None)
    label = f"""Object = IsisCube
  Object = Core
    StartByte = 4097
    Format = BandSequential
    Group = Dimensions
      Samples = {cols}
      Lines = {rows}
      Bands = 1
    End_Group
    Group = Pixels
      Type = {ISIS_TYPES[str(values.dtype)]}
      ByteOrder = Lsb
      Base = {base}
      Multiplier = {multiplier}
    End_Group
  End_Object
  Group = Mapping
{group}  End_Group
End_Object
Object = Label
  Bytes = 4096
End_Object
End
"""
    path.write_bytes(label.encode().ljust(4096, b"\0") + values.tobytes())
    return path


PDS3_TYPES = {"int16": "LSB_INTEGER", "uint8": "UNSIGNED_INTEGER", "float32": "PC_REAL"}


def pds3_map(path, values, image=None, **mapping):
    """A PDS3 label and its image; `image` and `mapping` add to and replace their keywords."""
    rows, cols = values.shape
    values.tofile(path.with_suffix(".IMG"))
    words = {
        "MAP_PROJECTION_TYPE": '"SIMPLE CYLINDRICAL"',
        "A_AXIS_RADIUS": "1737.4 <km>",
        "B_AXIS_RADIUS": "1737.4 <km>",
        "C_AXIS_RADIUS": "1737.4 <km>",
        "POSITIVE_LONGITUDE_DIRECTION": '"EAST"',
        "CENTER_LATITUDE": "0 <deg>",
        "CENTER_LONGITUDE": "0 <deg>",
        "MAP_PROJECTION_ROTATION": "0.0",
        "MAP_SCALE": f"{2.0 * np.pi * 1737.4 / cols / 4.0:.9f} <km/pix>",
        "LINE_PROJECTION_OFFSET": f"{rows / 2.0 - 0.5} <pix>",
        "SAMPLE_PROJECTION_OFFSET": f"{cols / 2.0 - 0.5} <pix>",
        "COORDINATE_SYSTEM_TYPE": '"BODY-FIXED ROTATING"',
        "COORDINATE_SYSTEM_NAME": "PLANETOCENTRIC",
    } | mapping
    dtype = str(values.dtype)
    pixels = {
        "LINES": rows,
        "LINE_SAMPLES": cols,
        "SAMPLE_TYPE": PDS3_TYPES[dtype],
        "SAMPLE_BITS": 8 * values.dtype.itemsize,
    } | (image or {})
    size = cols * values.dtype.itemsize
    lines = ["PDS_VERSION_ID = PDS3", "RECORD_TYPE = FIXED_LENGTH", f"RECORD_BYTES = {size}"]
    lines += [f"FILE_RECORDS = {rows}", f'^IMAGE = "{path.stem}.IMG"', "TARGET_NAME = MOON"]
    lines += ["OBJECT = IMAGE", *(f"  {k} = {v}" for k, v in pixels.items()), "END_OBJECT = IMAGE"]
    lines += ["OBJECT = IMAGE_MAP_PROJECTION", *(f"  {k} = {v}" for k, v in words.items())]
    lines += ["END_OBJECT = IMAGE_MAP_PROJECTION", "END", ""]
    path.write_text("\r\n".join(lines))
    return path


PDS4_MAP = """<?xml version="1.0" encoding="UTF-8"?>
<Product_Observational xmlns="http://pds.nasa.gov/pds4/pds/v1" \
xmlns:cart="http://pds.nasa.gov/pds4/cart/v1" xmlns:disp="http://pds.nasa.gov/pds4/disp/v1">
<Identification_Area><logical_identifier>urn:nasa:pds:a:b:c</logical_identifier>
</Identification_Area><Observation_Area><Discipline_Area>
<disp:Display_Settings><Local_Internal_Reference>
<local_identifier_reference>image</local_identifier_reference></Local_Internal_Reference>
<disp:Display_Direction><disp:horizontal_display_axis>Sample</disp:horizontal_display_axis>
<disp:horizontal_display_direction>{across}</disp:horizontal_display_direction>
<disp:vertical_display_axis>Line</disp:vertical_display_axis>
<disp:vertical_display_direction>{down}</disp:vertical_display_direction></disp:Display_Direction>
</disp:Display_Settings>
<cart:Cartography><Local_Internal_Reference>
<local_identifier_reference>image</local_identifier_reference></Local_Internal_Reference>
<cart:Spatial_Reference_Information><cart:Horizontal_Coordinate_System_Definition><cart:Planar>
<cart:Map_Projection><cart:map_projection_name>Equirectangular</cart:map_projection_name>
<cart:Equirectangular><cart:standard_parallel_1 unit="deg">0</cart:standard_parallel_1>
<cart:longitude_of_central_meridian unit="deg">{centre}</cart:longitude_of_central_meridian>
<cart:latitude_of_projection_origin unit="deg">0</cart:latitude_of_projection_origin>
</cart:Equirectangular></cart:Map_Projection><cart:Planar_Coordinate_Information>
<cart:planar_coordinate_encoding_method>Coordinate Pair</cart:planar_coordinate_encoding_method>
<cart:Coordinate_Representation>
<cart:pixel_resolution_x unit="m/pixel">{step}</cart:pixel_resolution_x>
<cart:pixel_resolution_y unit="m/pixel">{step}</cart:pixel_resolution_y>
</cart:Coordinate_Representation></cart:Planar_Coordinate_Information><cart:Geo_Transformation>
<cart:upperleft_corner_x unit="m">{left}</cart:upperleft_corner_x>
<cart:upperleft_corner_y unit="m">{top}</cart:upperleft_corner_y>
</cart:Geo_Transformation></cart:Planar>
<cart:Geodetic_Model><cart:latitude_type>{latitudes}</cart:latitude_type>
<cart:spheroid_name>Moon</cart:spheroid_name>
<cart:semi_major_radius unit="km">1737.4</cart:semi_major_radius>
<cart:semi_minor_radius unit="km">1737.4</cart:semi_minor_radius>
<cart:polar_radius unit="km">{polar}</cart:polar_radius>
<cart:longitude_direction>{direction}</cart:longitude_direction></cart:Geodetic_Model>
</cart:Horizontal_Coordinate_System_Definition></cart:Spatial_Reference_Information>
</cart:Cartography></Discipline_Area></Observation_Area>
<File_Area_Observational><File><file_name>{image}</file_name></File><Array_2D_Image>
<local_identifier>image</local_identifier><offset unit="byte">0</offset><axes>2</axes>
<axis_index_order>Last Index Fastest</axis_index_order><Element_Array>
<data_type>SignedLSB2</data_type><unit>{unit}</unit><scaling_factor>1</scaling_factor>
<value_offset>0</value_offset></Element_Array>
<Axis_Array><axis_name>Line</axis_name><elements>{rows}</elements>
<sequence_number>1</sequence_number></Axis_Array>
<Axis_Array><axis_name>Sample</axis_name><elements>{cols}</elements>
<sequence_number>2</sequence_number></Axis_Array>{constants}
</Array_2D_Image></File_Area_Observational></Product_Observational>"""


def pds4_map(path, values, constants="", **words):
    """A PDS4 label and its image of signed words; `words` replace those of the label."""
    rows, cols = values.shape
    values.astype("<i2").tofile(path.with_suffix(".img"))
    step = 2.0 * np.pi * 1737400.0 / cols / 4.0
    stated = {
        "across": "Left to Right",
        "down": "Top to Bottom",
        "centre": 0,
        "step": f"{step:.6f}",
        "left": f"{-step * cols / 2.0:.6f}",
        "top": f"{step * rows / 2.0:.6f}",
        "latitudes": "Planetocentric",
        "polar": 1737.4,
        "direction": "Positive East",
        "unit": "m",
        "rows": rows,
        "cols": cols,
        "image": path.with_suffix(".img").name,
    } | words
    inner = f"<Special_Constants>{constants}</Special_Constants>" if constants else ""
    path.write_text(PDS4_MAP.format(constants=inner, **stated))
    return path
