"""Writes `messages.json`: messages as two independent encoders make them, asn1tools and pycrate.

    pip install asn1tools==0.169.0 pycrate==0.8.1
    python messages.py FOLDER

FOLDER has ETSI's modules as files: `cam_1_4_1.asn`, `denm_1_3_1.asn`, `cdd_1_3_1_1.asn`, `cpm_2_1_1.asn` and
`cdd_2_2_1.asn` (all five modules of the collective perception message in one file), as the crate c-its-parser 2.4.2
carries them in `autogen/asn.1`. pycrate brings ETSI's modules of the CAM, the DENM and the VAM, and compiles those of
the CPM. The parts of a VAM and of J2735's core that are sent are in [`VAM`] and [`BSM`].
"""

import json
import random
import re
import runpy
import sys
import tempfile
from pathlib import Path

import asn1tools
from pycrate_asn1c.asnproc import PycrateGenerator, compile_text, generate_modules
from pycrate_asn1dir.ITS_CAM_2 import CAM_PDU_Descriptions
from pycrate_asn1dir.ITS_DENM_3 import DENM_PDU_Descriptions
from pycrate_asn1dir.ITS_VAM_3 import VAM_PDU_Descriptions

MESSAGES = 30

# TS 103 300-3 V2.1.1, annex A, with the types of TS 102 894-2 in place of their imports. Containers that are never
# sent are a null: their bits are zero.
VAM = """
VAM-Sent DEFINITIONS AUTOMATIC TAGS ::= BEGIN
VAM ::= SEQUENCE { header Header, vam SEQUENCE { generationDeltaTime INTEGER (0..65535), vamParameters Parameters } }
Header ::= SEQUENCE { protocolVersion INTEGER (0..255), messageID INTEGER (0..255), stationID INTEGER (0..4294967295) }
Parameters ::= SEQUENCE {
    basicContainer SEQUENCE { stationType INTEGER (0..255), referencePosition Position, ... },
    vruHighFrequencyContainer High OPTIONAL, vruLowFrequencyContainer Low OPTIONAL,
    vruClusterInformationContainer NULL OPTIONAL, vruClusterOperationContainer NULL OPTIONAL,
    vruMotionPredictionContainer NULL OPTIONAL, ... }
Position ::= SEQUENCE {
    latitude INTEGER (-900000000..900000001), longitude INTEGER (-1800000000..1800000001),
    positionConfidenceEllipse SEQUENCE {
        semiMajorConfidence INTEGER (0..4095), semiMinorConfidence INTEGER (0..4095),
        semiMajorOrientation INTEGER (0..3601) },
    altitude SEQUENCE { altitudeValue INTEGER (-100000..800001), altitudeConfidence ENUMERATED {
        alt-000-01, alt-000-02, alt-000-05, alt-000-10, alt-000-20, alt-000-50, alt-001-00, alt-002-00, alt-005-00,
        alt-010-00, alt-020-00, alt-050-00, alt-100-00, alt-200-00, outOfRange, unavailable } } }
High ::= SEQUENCE {
    heading SEQUENCE { headingValue INTEGER (0..3601), headingConfidence INTEGER (1..127) },
    speed SEQUENCE { speedValue INTEGER (0..16383), speedConfidence INTEGER (1..127) },
    longitudinalAcceleration SEQUENCE {
        longitudinalAccelerationValue INTEGER (-160..161), longitudinalAccelerationConfidence INTEGER (0..102) },
    curvature NULL OPTIONAL, curvatureCalculationMode NULL OPTIONAL, yawRate NULL OPTIONAL,
    lateralAcceleration NULL OPTIONAL, verticalAcceleration NULL OPTIONAL, vruLanePosition NULL OPTIONAL,
    environment NULL OPTIONAL, movementControl NULL OPTIONAL, orientation NULL OPTIONAL, rollAngle NULL OPTIONAL,
    deviceUsage NULL OPTIONAL, ... }
Low ::= SEQUENCE {
    profileAndSubprofile CHOICE {
        pedestrian ENUMERATED {
            unavailable(0), ordinary-pedestrian(1), road-worker(2), first-responder(3), max(15) },
        bicyclist NULL, motorcylist NULL, animal NULL, ... } OPTIONAL,
    exteriorLights NULL OPTIONAL,
    sizeClass ENUMERATED { unavailable(0), low(1), medium(2), high(3), max(15) } OPTIONAL, ... }
END
"""

# SAE J2735, 2016 and later: the frame and the core of the basic safety message; what is never sent is a null.
BSM = """
BSM-Sent DEFINITIONS AUTOMATIC TAGS ::= BEGIN
MessageFrame ::= SEQUENCE { messageId INTEGER (0..32767), value OCTET STRING, ... }
BasicSafetyMessage ::= SEQUENCE { coreData BSMcoreData, partII NULL OPTIONAL, regional NULL OPTIONAL, ... }
BSMcoreData ::= SEQUENCE {
    msgCnt INTEGER (0..127), id OCTET STRING (SIZE (4)), secMark INTEGER (0..65535),
    lat INTEGER (-900000000..900000001), long INTEGER (-1799999999..1800000001), elev INTEGER (-4096..61439),
    accuracy SEQUENCE { semiMajor INTEGER (0..255), semiMinor INTEGER (0..255), orientation INTEGER (0..65535) },
    transmission ENUMERATED {
        neutral, park, forwardGears, reverseGears, reserved1, reserved2, reserved3, unavailable },
    speed INTEGER (0..8191), heading INTEGER (0..28800), angle INTEGER (-126..127),
    accelSet SEQUENCE {
        long INTEGER (-2000..2001), lat INTEGER (-2000..2001), vert INTEGER (-127..127), yaw INTEGER (-32767..32767) },
    brakes SEQUENCE {
        wheelBrakes BIT STRING (SIZE (5)), traction Control, abs Control, scs Control, brakeBoost Boost,
        auxBrakes Auxiliary },
    size SEQUENCE { width INTEGER (0..1023), length INTEGER (0..4095) } }
Control ::= ENUMERATED { unavailable, off, on, engaged }
Boost ::= ENUMERATED { unavailable, off, on }
Auxiliary ::= ENUMERATED { unavailable, off, on, reserved }
END
"""
FOLDER = Path(sys.argv[1])


def read(*names: str) -> list[str]:
    """The modules as text, without comments, and without constraints on inner components.

    No bit of the packed encoding shows these constraints, and pycrate does not read all of them.
    """
    texts = [(FOLDER / name).read_text() for name in names]
    plain = [without_inner_constraints(re.sub(r"/\*.*?\*/|--.*?$", "", text, flags=re.S | re.M)) for text in texts]
    # The size of a polygon, which no message here has: pycrate stops at a range that narrows another with an extension.
    return [re.sub(r"\(SIZE\s*\(3\.\.16\s*,\s*\.\.\.\)\)", "", text) for text in plain]


def without_inner_constraints(text: str) -> str:
    """Leaves out every pair of parentheses around `WITH COMPONENT…`."""
    while found := re.search(r"\((?:\s*\()*\s*WITH\s+COMPONENT", text):
        depth, end = 0, found.start()
        while depth or end == found.start():
            depth += {"(": 1, ")": -1}.get(text[end], 0)
            end += 1
        text = text[: found.start()] + text[end:]
    return text


def optional(draw: random.Random, value: int) -> int | None:
    """`value`, or nothing in a quarter of all cases."""
    return value if draw.random() < 0.75 else None


def position(draw: random.Random) -> dict[str, int | None]:
    """A position as the Rust type has it."""
    return {
        "latitude": draw.choice([-900_000_000, 900_000_000, draw.randint(-900_000_000, 900_000_000)]),
        "longitude": draw.randint(-1_800_000_000, 1_800_000_000),
        "accuracy_cm": optional(draw, draw.randint(0, 4094)),
        "altitude_cm": optional(draw, draw.randint(-100_000, 800_000)),
    }


def reference_position(values: dict[str, int | None]) -> dict[str, object]:
    """The same in ETSI's names."""
    axis = values["accuracy_cm"]
    return {
        "latitude": values["latitude"],
        "longitude": values["longitude"],
        "positionConfidenceEllipse": {
            "semiMajorConfidence": 4095 if axis is None else axis,
            "semiMinorConfidence": 4095 if axis is None else axis,
            "semiMajorOrientation": 3601 if axis is None else 0,
        },
        "altitude": {
            "altitudeValue": 800_001 if values["altitude_cm"] is None else values["altitude_cm"],
            "altitudeConfidence": "unavailable",
        },
    }


def cam(draw: random.Random) -> dict[str, object]:
    """Values of a cooperative awareness message."""
    path = [
        {
            "delta_latitude": draw.randint(-131_071, 131_072),
            "delta_longitude": draw.randint(-131_071, 131_072),
            "time_10ms": optional(draw, draw.randint(1, 65_535)),
        }
        for _ in range(draw.choice([0, 1, 5, 40]))
    ]
    return {
        "station": draw.randint(0, 2**32 - 1),
        "kind": draw.randint(0, 255),
        "generation_delta_ms": draw.randint(0, 65_535),
        "position": position(draw),
        "heading": optional(draw, draw.randint(0, 3600)),
        "heading_confidence": optional(draw, draw.randint(1, 126)),
        "speed_cmps": optional(draw, draw.randint(0, 16_382)),
        "speed_confidence": optional(draw, draw.randint(1, 126)),
        "length_10cm": draw.randint(1, 1023),
        "width_10cm": draw.randint(1, 62),
        "acceleration": optional(draw, draw.randint(-160, 160)),
        "yaw_rate": optional(draw, draw.randint(-32_766, 32_766)),
        "path": path if draw.random() < 0.5 else None,
    }


def or_else(value: object, unavailable: int) -> object:
    """`value`, or the number that stands for none."""
    return unavailable if value is None else value


def roadside_cam(draw: random.Random) -> dict:
    """Values of a roadside unit's message."""
    return {
        "station": draw.randint(0, 2**32 - 1),
        "generation_delta_ms": draw.randint(0, 65_535),
        "position": position(draw),
    }


def roadside_cam_pdu(values: dict) -> dict:
    """The message in ETSI's names."""
    parameters = {
        "basicContainer": {"stationType": 15, "referencePosition": reference_position(values["position"])},
        "highFrequencyContainer": ("rsuContainerHighFrequency", {}),
    }
    return {
        "header": {"protocolVersion": 2, "messageID": 2, "stationID": values["station"]},
        "cam": {"generationDeltaTime": values["generation_delta_ms"], "camParameters": parameters},
    }


def cam_pdu(values: dict) -> dict:
    """The message in ETSI's names."""
    high = {
        "heading": {
            "headingValue": or_else(values["heading"], 3601),
            "headingConfidence": or_else(values["heading_confidence"], 127),
        },
        "speed": {
            "speedValue": or_else(values["speed_cmps"], 16_383),
            "speedConfidence": or_else(values["speed_confidence"], 127),
        },
        "driveDirection": "forward",
        "vehicleLength": {
            "vehicleLengthValue": values["length_10cm"],
            "vehicleLengthConfidenceIndication": "noTrailerPresent",
        },
        "vehicleWidth": values["width_10cm"],
        "longitudinalAcceleration": {
            "longitudinalAccelerationValue": or_else(values["acceleration"], 161),
            "longitudinalAccelerationConfidence": 102,
        },
        "curvature": {"curvatureValue": 1023, "curvatureConfidence": "unavailable"},
        "curvatureCalculationMode": "unavailable",
        "yawRate": {"yawRateValue": or_else(values["yaw_rate"], 32_767), "yawRateConfidence": "unavailable"},
    }
    parameters = {
        "basicContainer": {"stationType": values["kind"], "referencePosition": reference_position(values["position"])},
        "highFrequencyContainer": ("basicVehicleContainerHighFrequency", high),
    }
    if values["path"] is not None:
        points = []
        for point in values["path"]:
            delta = {
                "deltaLatitude": point["delta_latitude"],
                "deltaLongitude": point["delta_longitude"],
                "deltaAltitude": 12_800,
            }
            time = {} if point["time_10ms"] is None else {"pathDeltaTime": point["time_10ms"]}
            points.append({"pathPosition": delta, **time})
        low = {"vehicleRole": "default", "exteriorLights": (b"\0", 8), "pathHistory": points}
        parameters["lowFrequencyContainer"] = ("basicVehicleContainerLowFrequency", low)
    return {
        "header": {"protocolVersion": 2, "messageID": 2, "stationID": values["station"]},
        "cam": {"generationDeltaTime": values["generation_delta_ms"], "camParameters": parameters},
    }


def cpm(draw: random.Random) -> dict:
    """Values of a collective perception message."""
    objects = [
        {
            "object": draw.randint(0, 65_535),
            "delta_ms": draw.randint(-2048, 2047),
            "position_cm": [draw.randint(-131_072, 131_071) for _ in range(2)],
            "position_confidence_cm": draw.randint(1, 4096),
            "velocity_cmps": [draw.randint(-16_383, 16_383) for _ in range(2)],
            "velocity_confidence": draw.randint(1, 127),
            "angle": draw.randint(0, 3601),
            "size_10cm": [draw.randint(1, 256) for _ in range(2)],
            "quality": draw.randint(0, 15),
            "is_person": draw.random() < 0.3,
        }
        for _ in range(draw.choice([0, 1, 3, 10, 40]))
    ]
    return {
        "station": draw.randint(0, 2**32 - 1),
        "reference_time_ms": draw.randint(0, 4_398_046_511_103),
        "position": position(draw),
        "heading": draw.randint(0, 3601),
        "sensor_range_10cm": optional(draw, draw.randint(0, 4095)),
        "perceived": draw.randint(0, 255) if objects else 0,
        "objects": objects,
    }


def roadside_cpm(draw: random.Random) -> dict:
    """Values of a roadside unit's message: it has no orientation, and its sensor may see a sector."""
    values = cpm(draw)
    del values["heading"]
    opening = [draw.randint(0, 3600) for _ in range(2)]
    return {**values, "opening": opening if draw.random() < 0.5 else None}


def cpm_pdu(values: dict) -> dict:
    """The message in ETSI's names."""
    containers = [{"containerId": 2, "containerData": ("OriginatingRsuContainer", {})}]
    if (heading := values.get("heading")) is not None:
        vehicle = {"orientationAngle": {"value": heading, "confidence": 127}}
        containers = [{"containerId": 1, "containerData": ("OriginatingVehicleContainer", vehicle)}]
    if values["sensor_range_10cm"] is not None:
        shape: tuple = ("circular", {"radius": values["sensor_range_10cm"]})
        if (opening := values.get("opening")) is not None:
            angles = {"horizontalOpeningAngleStart": opening[0], "horizontalOpeningAngleEnd": opening[1]}
            shape = ("radial", {"range": values["sensor_range_10cm"], **angles})
        sensor = {"sensorId": 1, "sensorType": 12, "perceptionRegionShape": shape, "shadowingApplies": True}
        containers.append({"containerId": 3, "containerData": ("SensorInformationContainer", [sensor])})
    if values["objects"]:
        content = {
            "numberOfPerceivedObjects": values["perceived"],
            "perceivedObjects": [cpm_object(one) for one in values["objects"]],
        }
        containers.append({"containerId": 5, "containerData": ("PerceivedObjectContainer", content)})
    return {
        "header": {"protocolVersion": 2, "messageId": 14, "stationId": values["station"]},
        "payload": {
            "managementContainer": {
                "referenceTime": values["reference_time_ms"],
                "referencePosition": reference_position(values["position"]),
            },
            "cpmContainers": containers,
        },
    }


def cpm_object(values: dict) -> dict:
    """A perceived object in ETSI's names."""
    coordinates = [{"value": value, "confidence": values["position_confidence_cm"]} for value in values["position_cm"]]
    components = [{"value": value, "confidence": values["velocity_confidence"]} for value in values["velocity_cmps"]]
    along, across = ({"value": value, "confidence": 32} for value in values["size_10cm"])
    person = {"objectClass": ("vruSubClass", ("pedestrian", 1)), "confidence": 101}
    return {
        "objectId": values["object"],
        "measurementDeltaTime": values["delta_ms"],
        "position": {"xCoordinate": coordinates[0], "yCoordinate": coordinates[1]},
        "velocity": ("cartesianVelocity", {"xVelocity": components[0], "yVelocity": components[1]}),
        "angles": {"zAngle": {"value": values["angle"], "confidence": 127}},
        "objectDimensionX": along,
        "objectDimensionY": across,
        "objectPerceptionQuality": values["quality"],
        **({"classification": [person]} if values["is_person"] else {}),
    }


def denm(draw: random.Random) -> dict:
    """Values of a notification: a cancellation has no event."""
    event = {
        "quality": draw.randint(0, 7),
        "cause": [draw.randint(0, 255) for _ in range(2)],
        "speed_cmps": optional(draw, draw.randint(0, 16_383)),
        "heading": optional(draw, draw.randint(0, 3601)),
    }
    is_ended = draw.random() < 0.3
    return {
        "station": draw.randint(0, 2**32 - 1),
        "kind": draw.randint(0, 255),
        "originator": draw.randint(0, 2**32 - 1),
        "sequence": draw.randint(0, 65_535),
        "detected_ms": draw.randint(0, 4_398_046_511_103),
        "reference_ms": draw.randint(0, 4_398_046_511_103),
        "termination": draw.randint(0, 1) if is_ended else None,
        "position": position(draw),
        "relevance": optional(draw, draw.randint(0, 7)),
        "traffic": optional(draw, draw.randint(0, 3)),
        "validity_s": draw.choice([2, 600, 86_400]),
        "interval_ms": optional(draw, draw.randint(1, 10_000)),
        "event": None if is_ended else event,
    }


RELEVANCE = ["lessThan50m", "lessThan100m", "lessThan200m", "lessThan500m"]
RELEVANCE += ["lessThan1000m", "lessThan5km", "lessThan10km", "over10km"]
TRAFFIC = ["allTrafficDirections", "upstreamTraffic", "downstreamTraffic", "oppositeTraffic"]
TERMINATION = ["isCancellation", "isNegation"]


def denm_pdu(values: dict) -> dict:
    """The message in ETSI's names."""
    management = {
        "actionID": {"originatingStationID": values["originator"], "sequenceNumber": values["sequence"]},
        "detectionTime": values["detected_ms"],
        "referenceTime": values["reference_ms"],
        "eventPosition": reference_position(values["position"]),
        "stationType": values["kind"],
    }
    for name, value in (
        ("termination", None if values["termination"] is None else TERMINATION[values["termination"]]),
        ("relevanceDistance", None if values["relevance"] is None else RELEVANCE[values["relevance"]]),
        ("relevanceTrafficDirection", None if values["traffic"] is None else TRAFFIC[values["traffic"]]),
        # The default is not encoded; pycrate would do it if it were given.
        ("validityDuration", None if values["validity_s"] == 600 else values["validity_s"]),
        ("transmissionInterval", values["interval_ms"]),
    ):
        if value is not None:
            management[name] = value
    notification: dict[str, object] = {"management": management}
    if event := values["event"]:
        cause, sub_cause = event["cause"]
        notification["situation"] = {
            "informationQuality": event["quality"],
            "eventType": {"causeCode": cause, "subCauseCode": sub_cause},
        }
        location: dict[str, object] = {"traces": [[]]}
        if event["speed_cmps"] is not None:
            location["eventSpeed"] = {"speedValue": event["speed_cmps"], "speedConfidence": 127}
        if event["heading"] is not None:
            location["eventPositionHeading"] = {"headingValue": event["heading"], "headingConfidence": 127}
        notification["location"] = location
    return {"header": {"protocolVersion": 2, "messageID": 1, "stationID": values["station"]}, "denm": notification}


SUBPROFILES = ["unavailable", "ordinary-pedestrian", "road-worker", "first-responder", "max"]
SIZE_CLASSES = ["unavailable", "low", "medium", "high", "max"]


def vam(draw: random.Random) -> dict:
    """Values of a person's message."""
    profile = {"subprofile": draw.randint(0, 4), "size_class": draw.randint(0, 4)}
    return {
        "station": draw.randint(0, 2**32 - 1),
        "kind": draw.randint(0, 255),
        "generation_delta_ms": draw.randint(0, 65_535),
        "position": position(draw),
        "heading": optional(draw, draw.randint(0, 3600)),
        "heading_confidence": optional(draw, draw.randint(1, 126)),
        "speed_cmps": optional(draw, draw.randint(0, 16_382)),
        "speed_confidence": optional(draw, draw.randint(1, 126)),
        "acceleration": optional(draw, draw.randint(-160, 160)),
        "profile": profile if draw.random() < 0.5 else None,
    }


def vam_pdu(values: dict) -> dict:
    """The message in ETSI's names."""
    high = {
        "heading": {
            "headingValue": or_else(values["heading"], 3601),
            "headingConfidence": or_else(values["heading_confidence"], 127),
        },
        "speed": {
            "speedValue": or_else(values["speed_cmps"], 16_383),
            "speedConfidence": or_else(values["speed_confidence"], 127),
        },
        "longitudinalAcceleration": {
            "longitudinalAccelerationValue": or_else(values["acceleration"], 161),
            "longitudinalAccelerationConfidence": 102,
        },
    }
    parameters = {
        "basicContainer": {"stationType": values["kind"], "referencePosition": reference_position(values["position"])},
        "vruHighFrequencyContainer": high,
    }
    if profile := values["profile"]:
        parameters["vruLowFrequencyContainer"] = {
            "profileAndSubprofile": ("pedestrian", SUBPROFILES[profile["subprofile"]]),
            "sizeClass": SIZE_CLASSES[profile["size_class"]],
        }
    return {
        "header": {"protocolVersion": 2, "messageID": 14, "stationID": values["station"]},
        "vam": {"generationDeltaTime": values["generation_delta_ms"], "vamParameters": parameters},
    }


TRANSMISSION = ["neutral", "park", "forwardGears", "reverseGears"]
TRANSMISSION += ["reserved1", "reserved2", "reserved3", "unavailable"]


def bsm(draw: random.Random) -> dict:
    """Values of a basic safety message."""
    return {
        "count": draw.randint(0, 127),
        "id": draw.randint(0, 2**32 - 1),
        "second_mark_ms": optional(draw, draw.randint(0, 60_999)),
        "latitude": optional(draw, draw.choice([-900_000_000, 900_000_000, draw.randint(-900_000_000, 900_000_000)])),
        "longitude": optional(draw, draw.randint(-1_799_999_999, 1_800_000_000)),
        "elevation_10cm": optional(draw, draw.randint(-4095, 61_439)),
        "accuracy_5cm": optional(draw, [draw.randint(0, 254) for _ in range(2)]),
        "transmission": draw.randint(0, 7),
        "speed": optional(draw, draw.randint(0, 8190)),
        "heading": optional(draw, draw.randint(0, 28_799)),
        "steering_wheel": optional(draw, draw.randint(-126, 126)),
        "acceleration": [optional(draw, draw.randint(-2000, 2000)) for _ in range(2)],
        "yaw_rate": draw.randint(-32_767, 32_767),
        "wheel_brakes": optional(draw, [draw.random() < 0.5 for _ in range(4)]),
        "width_cm": draw.randint(0, 1023),
        "length_cm": draw.randint(0, 4095),
    }


def bsm_pdu(values: dict) -> dict:
    """The message in SAE's names."""
    axes = or_else(values["accuracy_5cm"], [255, 255])
    brakes = values["wheel_brakes"]
    bits = [brakes is None, *(brakes or [False] * 4)]
    wheels = sum(bit << (7 - place) for place, bit in enumerate(bits))
    return {
        "coreData": {
            "msgCnt": values["count"],
            "id": values["id"].to_bytes(4, "big"),
            "secMark": or_else(values["second_mark_ms"], 65_535),
            "lat": or_else(values["latitude"], 900_000_001),
            "long": or_else(values["longitude"], 1_800_000_001),
            "elev": or_else(values["elevation_10cm"], -4096),
            "accuracy": {"semiMajor": axes[0], "semiMinor": axes[1], "orientation": 65_535},
            "transmission": TRANSMISSION[values["transmission"]],
            "speed": or_else(values["speed"], 8191),
            "heading": or_else(values["heading"], 28_800),
            "angle": or_else(values["steering_wheel"], 127),
            "accelSet": {
                "long": or_else(values["acceleration"][0], 2001),
                "lat": or_else(values["acceleration"][1], 2001),
                "vert": -127,
                "yaw": values["yaw_rate"],
            },
            "brakes": {
                "wheelBrakes": (bytes([wheels]), 5),
                **dict.fromkeys(["traction", "abs", "scs", "brakeBoost", "auxBrakes"], "unavailable"),
            },
            "size": {"width": values["width_cm"], "length": values["length_cm"]},
        }
    }


def for_asn1tools(pdu: dict, codec: object) -> dict:
    """asn1tools takes open types as bytes."""
    containers = [
        {"containerId": one["containerId"], "containerData": codec.encode(*one["containerData"])}
        for one in pdu["payload"]["cpmContainers"]
    ]
    return {**pdu, "payload": {**pdu["payload"], "cpmContainers": containers}}


def for_pycrate(value: object) -> object:
    """pycrate takes a bit string as number and length."""
    if isinstance(value, dict):
        return {key: for_pycrate(part) for key, part in value.items()}
    if isinstance(value, list):
        return [for_pycrate(part) for part in value]
    if isinstance(value, tuple) and isinstance(value[0], bytes):
        return (int.from_bytes(value[0], "big") >> (8 * len(value[0]) - value[1]), value[1])
    if isinstance(value, tuple):
        return (value[0], for_pycrate(value[1]))
    return value


def by_pycrate_compiled(text: str) -> dict:
    """pycrate's modules of a text, by name."""
    compile_text(text)
    with tempfile.TemporaryDirectory() as folder:
        generate_modules(PycrateGenerator, f"{folder}/compiled.py")
        return runpy.run_path(f"{folder}/compiled.py")


def by_asn1tools(kind: str, codec: object, name: str, message: dict) -> bytes:
    """The bytes by asn1tools, which decodes them as the same."""
    if kind.endswith("cpm"):
        message = for_asn1tools(message, codec)
    encoded = codec.encode(name, message)
    assert codec.encode(name, codec.decode(name, encoded)) == encoded
    if kind != "bsm":
        return encoded
    return codec.encode("MessageFrame", {"messageId": 20, "value": encoded})


def by_pycrate(kind: str, types: tuple, message: dict) -> bytes:
    """The bytes by pycrate, which decodes them as the same."""
    kind_of = types[-1]
    kind_of.set_val(for_pycrate(message))
    encoded = kind_of.to_uper()
    kind_of.from_uper(encoded)
    assert kind_of.to_uper() == encoded
    if kind != "bsm":
        return encoded
    types[0].set_val({"messageId": 20, "value": encoded})
    return types[0].to_uper()


def main() -> None:
    """Encode with both, compare, decode with both, write."""
    cam_files, cpm_files = ("cam_1_4_1.asn", "cdd_1_3_1_1.asn"), ("cpm_2_1_1.asn", "cdd_2_2_1.asn")
    compiled = {
        "cam": "\n".join(read(*cam_files)),
        "cpm": "\n".join(read(*cpm_files)),
        "denm": "\n".join(read("denm_1_3_1.asn", "cdd_1_3_1_1.asn")),
        "vam": VAM,
        "bsm": BSM,
    }
    compiled |= {f"roadside_{kind}": compiled[kind] for kind in ("cam", "cpm")}
    cam_types = (CAM_PDU_Descriptions.CAM,)
    modules = by_pycrate_compiled(compiled["bsm"] + compiled["cpm"])
    bsm_types = (modules["BSM_Sent"].MessageFrame, modules["BSM_Sent"].BasicSafetyMessage)
    cpm_types = (modules["CPM_PDU_Descriptions"].CollectivePerceptionMessage,)
    kinds = (
        ("cam", cam, cam_pdu, "CAM", cam_types),
        ("cpm", cpm, cpm_pdu, "CollectivePerceptionMessage", cpm_types),
        ("denm", denm, denm_pdu, "DENM", (DENM_PDU_Descriptions.DENM,)),
        ("vam", vam, vam_pdu, "VAM", (VAM_PDU_Descriptions.VAM,)),
        ("bsm", bsm, bsm_pdu, "BasicSafetyMessage", bsm_types),
        ("roadside_cam", roadside_cam, roadside_cam_pdu, "CAM", cam_types),
        ("roadside_cpm", roadside_cpm, cpm_pdu, "CollectivePerceptionMessage", cpm_types),
    )
    # CAMs and CPMs draw on from one to the other; each of the others by itself.
    draws = {"cam": random.Random(302_637)}
    draws["cpm"] = draws["cam"]
    out = {}
    for kind, make, pdu, name, types in kinds:
        draw = draws.get(kind, random.Random(kind))
        codec = asn1tools.compile_string(compiled[kind], "uper")
        out[kind] = []
        for _ in range(MESSAGES):
            values = make(draw)
            message = pdu(values)
            encoded = by_asn1tools(kind, codec, name, message)
            assert by_pycrate(kind, types, message) == encoded, (kind, values)
            out[kind].append({"hex": encoded.hex(), "values": values})
    rows = {kind: ",\n".join(json.dumps(one) for one in messages) for kind, messages in out.items()}
    text = ",\n".join(f'"{kind}": [\n{row}\n]' for kind, row in rows.items())
    Path(__file__).with_suffix(".json").write_text("{" + text + "}\n")


if __name__ == "__main__":
    main()
