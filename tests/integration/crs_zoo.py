"""Coordinate reference systems of every kind, as names that PROJ resolves, and as WKT."""

from __future__ import annotations

import re

from pyproj import CRS

_EPSG = """
4326 4258 4269 4267 4230 4807 4901 4902 7844 9057 9755 9990 4978 4979 7843 3857 32632 2154 27700
27572 27571 3035 5514 2065 2193 2056 31467 28992 3067 2393 3301 3346 2053 29371 2036 2227 26786 5070
3031 3571 3034 3577 28355 31700 20008 5042 32661 6933 27205 2192 27391 29873 3375 5880 29100 29901
29903 2157 8857 6842 22832 10481 9895 9377 9221 8395 8065 7415 7405 5554 5498 6893 9518 7423 5698
5972 7417 9286 8360 3901 6349 5500 9707 5556 9453 5628 6144
"""

_OTHERS = """
ESRI:54009 ESRI:54008 ESRI:54030 ESRI:54034 ESRI:54052 ESRI:54042 ESRI:53004 ESRI:102003 ESRI:102008
ESRI:102100 ESRI:102113 ESRI:102025 ESRI:103300 ESRI:104905 ESRI:104903 ESRI:54098 ESRI:102035
ESRI:54043 ESRI:37001 IAU_2015:30100 IAU_2015:49900 OGC:CRS84 OGC:CRS83 OGC:CRS27 IGNF:LAMB93
IGNF:NTFLAMB2E IGNF:ETRS89LAEA
"""

_PROJ = """
+proj=utm +zone=33 +ellps=GRS80 +units=m
+proj=longlat +a=3396190 +b=3376200
+proj=longlat +R=6371000
+proj=nsper +h=3000000 +lat_0=40 +lon_0=10
+proj=tpers +h=5500000 +lat_0=40 +lon_0=-100
+proj=geos +h=35785831 +lon_0=0 +sweep=y
+proj=geos +h=35785831 +lon_0=-75 +sweep=x +ellps=GRS80
+proj=ob_tran +o_proj=longlat +o_lon_p=0 +o_lat_p=39.25 +lon_0=18 +R=6371229
+proj=tmerc +lat_0=0 +lon_0=9 +k=0.9996 +x_0=500000 +ellps=intl +towgs84=-87,-98,-121,0,0,0,0
+proj=longlat +ellps=bessel +towgs84=598.1,73.7,418.2,0.202,0.045,-2.455,6.7
+proj=laea +lat_0=45.5 +lon_0=-114.125 +datum=NAD83
+proj=aea +lat_1=20 +lat_2=60 +lat_0=40 +lon_0=-96 +units=us-ft
+proj=lcc +lat_1=30 +lat_2=60 +lat_0=45 +lon_0=10 +pm=paris +ellps=clrk80ign
+proj=sinu +R=6371007.181
+proj=eqc +lat_ts=30 +datum=WGS84
+proj=stere +lat_0=90 +lat_ts=70 +lon_0=-45 +R=6371228
+proj=omerc +lat_0=4 +lonc=115 +alpha=53.3158 +k=0.99984 +gamma=53.13
+proj=moll +lon_0=10
+proj=igh
+proj=robin
+proj=wintri
+proj=krovak +ellps=bessel
+proj=cass +lat_0=10 +lon_0=-61 +ellps=clrk66
+proj=aeqd +lat_0=52 +lon_0=5
+proj=gnom +lat_0=90 +lon_0=0
+proj=ortho +lat_0=40 +lon_0=0
+proj=cea +lat_ts=30
+proj=mill
+proj=goode
+proj=eck4
+proj=merc +lat_ts=10 +units=ft
+proj=utm +zone=33 +south +datum=WGS84 +units=km
+proj=somerc +lat_0=46.95 +lon_0=7.43 +x_0=600000 +y_0=200000 +ellps=bessel
+proj=tmerc +lat_0=0 +lon_0=21 +axis=wsu +ellps=WGS84
+proj=utm +zone=31 +datum=WGS84 +geoidgrids=egm96_15.gtx +vunits=m
+proj=imw_p +lat_1=30 +lat_2=40
+proj=eqearth
+proj=vandg
+proj=bonne +lat_1=40
+proj=nzmg +datum=nzgd49
+proj=labrd +lat_0=-18.9 +lon_0=46.43 +azi=18.9 +k=0.9995 +x_0=400000 +y_0=800000 +ellps=intl
+proj=qsc +lat_0=0 +lon_0=0
"""

DERIVED_PROJECTED = """
DERIVEDPROJCRS["site grid",BASEPROJCRS["WGS 84 / UTM zone 32N",
 BASEGEOGCRS["WGS 84",
 DATUM["World Geodetic System 1984",ELLIPSOID["WGS 84",6378137,298.257223563]]],
 CONVERSION["UTM zone 32N",METHOD["Transverse Mercator",ID["EPSG",9807]],
 PARAMETER["Latitude of natural origin",0,ANGLEUNIT["degree",0.0174532925199433]],
 PARAMETER["Longitude of natural origin",9,ANGLEUNIT["degree",0.0174532925199433]],
 PARAMETER["Scale factor at natural origin",0.9996,SCALEUNIT["unity",1]],
 PARAMETER["False easting",500000,LENGTHUNIT["metre",1]],
 PARAMETER["False northing",0,LENGTHUNIT["metre",1]]]],
 DERIVINGCONVERSION["turn",METHOD["Affine parametric transformation",ID["EPSG",9624]],
 PARAMETER["A0",100,LENGTHUNIT["metre",1],ID["EPSG",8623]],
 PARAMETER["A1",1,SCALEUNIT["coefficient",1],ID["EPSG",8624]],
 PARAMETER["A2",0.01,SCALEUNIT["coefficient",1],ID["EPSG",8625]],
 PARAMETER["B0",200,LENGTHUNIT["metre",1],ID["EPSG",8639]],
 PARAMETER["B1",-0.01,SCALEUNIT["coefficient",1],ID["EPSG",8640]],
 PARAMETER["B2",1,SCALEUNIT["coefficient",1],ID["EPSG",8641]]],
 CS[Cartesian,2],AXIS["easting",east],AXIS["northing",north],LENGTHUNIT["metre",1]]
"""

CUSTOM_DATUM = """
PROJCRS["mine",BASEGEOGCRS["mine",DATUM["of the mine",ELLIPSOID["theirs",6378200,298.5]]],
 CONVERSION["c",METHOD["Transverse Mercator"],
 PARAMETER["Latitude of natural origin",10,ANGLEUNIT["degree",0.0174532925199433]],
 PARAMETER["Longitude of natural origin",15,ANGLEUNIT["degree",0.0174532925199433]],
 PARAMETER["Scale factor at natural origin",1.00001,SCALEUNIT["unity",1]],
 PARAMETER["False easting",1000,LENGTHUNIT["yard",0.9144]],
 PARAMETER["False northing",2000,LENGTHUNIT["yard",0.9144]]],
 CS[Cartesian,2],AXIS["e",east],AXIS["n",north],LENGTHUNIT["yard",0.9144]]
"""

DIFFICULT = re.compile(
    "heights|2021|derived|first|custom|proj=(nsper|tpers|ob_tran|eqearth|krovak|longlat|geos|lcc)"
    "|ESRI:102035|IGNF|OGC|EPSG:(3067|31700|2192|29100|22832|7415|7405|5498|7423|7417|9286|3901"
    "|6349|5500|27572|27571|4807|4901|4902|2053|2036|3035|2393|5514|4979|4978)$"
)
"""Names of those that do not fit into GeoTIFF's keys, or of which one axis, unit or meridian is
unusual."""

ENGINEERING = """
ENGCRS["hall",EDATUM["corner"],CS[Cartesian,2],AXIS["x",east],AXIS["y",north],LENGTHUNIT["metre",1]]
"""

_DYNAMIC = ("EPSG:4326", "EPSG:9057", "EPSG:9755", "EPSG:9990", "EPSG:32632")
_THREE_DIMENSIONAL = ("EPSG:32632", "EPSG:2154", "EPSG:2193", "EPSG:2227", "EPSG:27700")


def zoo() -> dict[str, tuple[str, str]]:
    """WKT2 and attributes of GDAL's ``SRS`` element (epoch, axis mapping) by name."""
    codes = [*(f"EPSG:{code}" for code in _EPSG.split()), *_OTHERS.split()]
    names = [*codes, *_PROJ.strip().splitlines()]
    animals = {name: (_wkt(CRS.from_user_input(name)), "") for name in names}
    for name in _THREE_DIMENSIONAL:
        animals[f"{name} with heights"] = (_wkt(CRS(name).to_3d()), "")
    for name in _DYNAMIC:
        animals[f"{name} at 2021.3"] = (animals[name][0], 'coordinateEpoch="2021.3"')
    animals["derived projected"] = (DERIVED_PROJECTED, "")
    animals["custom datum"] = (CUSTOM_DATUM, "")
    animals["latitude first"] = (animals["EPSG:4326"][0], 'dataAxisToSRSAxisMapping="1,2"')
    return animals


def _wkt(crs: CRS) -> str:
    return crs.to_wkt("WKT2_2019")
