"""Keys of NXtomo and of Data Exchange."""

from mvrecon.core.files.keys import Key
from mvrecon.data.projections import exposures, nexus_axes, nexus_detector
from mvrecon.data.projections.frames import REGION
from mvrecon.data.projections.nexus_detector import BEAM, DETECTOR_BEAM

AXIS = "calibrate=[offset_u] finds the axis"
#: Data sets of NXtomo and Data Exchange.
KEYS = (
    Key("image_key", "applied", "0 views, 1 flat fields, 2 dark fields; 3, invalid, left out"),
    Key("image_key_control", "applied", "in place of image_key; -1, alignment, left out"),
    Key("data, views, data_white, data_dark", "applied", "frames, flat and dark fields"),
    Key("rotation_angle, theta", "applied", "of all frames or of the views; in its units"),
    Key("x_pixel_size, y_pixel_size", "applied", "of the sample, else of the detector, in units"),
    Key(
        "units",
        "refused",
        "of angles and lengths",
        ("degrees", "radians", "m", "mm", "um", "..."),
    ),
    Key(
        "data@units, data@unit",
        "compared",
        "with views.kind: those of line integrals are refused for others, and of line integrals a "
        "warning names those that need a factor",
    ),
    Key(
        "axes",
        "refused",
        "of Data Exchange's data; the last one for sinograms",
        ("theta:y:x", "y:theta:x"),
    ),
    Key("data@MATLAB_class", "compared", "warned of, as MATLAB reverses the order of axes"),
    Key("scale_factor, add_offset, _FillValue", "refused", "apply it", (1, 0, "nan")),
    Key("source/type", "applied", "or of any NXsource: beams of tubes are not parallel"),
    Key(
        ", ".join((*exposures.DETECTOR, *exposures.MONITORS)),
        "compared",
        "of views with fields, one number or one of each frame or view; warned of, applied by "
        "views.exposure, where others must agree",
    ),
    Key(
        "flat_exposure_time, different_flat_exposure",
        "compared",
        "of flat fields of Data Exchange, with its exposure_time, as count_time",
    ),
    Key(
        "DIMENSION_LABELS, rotation_angle_indices",
        "compared",
        "with the order of frames, rows and columns, as axes of NXdata and dimension scales",
    ),
    Key(", ".join(REGION), "compared", "areaDetector's, of views and fields"),
    Key("x_flipped, y_flipped", "compared", "views.flip_columns, flip_rows; warned of"),
    Key(
        "x_translation, y_translation, z_translation",
        "compared",
        "of sample and detector, of all views; warned of",
    ),
    Key(
        "instrument/<group>/attenuator_transmission",
        "compared",
        "as count_time, under this name, with the group's own",
    ),
    Key(
        ", ".join((*DETECTOR_BEAM, *BEAM)),
        "compared",
        "of all views and of fields in other files; warned of",
    ),
    Key("x_pixel_offset, y_pixel_offset, beam_center_x, beam_center_y", "ignored", AXIS),
    Key(
        "scaling_factor, offset, data_scaling_factor, data_offset",
        "refused",
        "fields beside the data set that they scale; apply them",
        (1, 0),
    ),
    Key(
        "field_of_view, half_acquisition, estimated_cor_from_motor, ?_rotation_axis_pixel_position",
        "ignored",
        AXIS,
    ),
    Key("real_x_pixel_size, real_y_pixel_size", "ignored", "of the camera behind its optics"),
    Key(
        "theta_white, theta_dark, distance, energy, provenance, definition, web_camera_frame, "
        "NDArrayUniqueId, NDArrayTimeStamp, NDArrayEpicsTS*",
        "ignored",
        "not needed",
    ),
    Key(
        "calibration_date, angular_calibration, azimuthal_angle, trigger_*, raw_time_of_flight, "
        "description, serial_number, local_name, type, layout, input, crate, slot, diameter, "
        "solid_angle, efficiency, gas_pressure, detection_gas_path, sensor_*, detector_number, "
        "acquisition_mode, frame_start_number, start_time, stop_time, detector_readout_time, "
        "tomo_n",
        "ignored",
        "of a detector of NeXus: not of values",
    ),
    Key(
        "name, title, short_title, chemical_formula, situation, preparation_date, temperature, "
        "electric_field, magnetic_field, stress_field, pressure, humidity, changer_position, "
        "unit_cell*, sample_orientation, "
        "orientation_matrix, ub_matrix, mass, density, relative_molecular_mass, concentration, "
        "volume_fraction, scattering_length_density, space_group, point_group, path_length*, "
        "component, sample_component, external_DAC, propagation_distance",
        "ignored",
        "of a sample of NeXus: not of places",
    ),
    Key(
        "flatfield, dead_time, countrate_correction_lookup_table",
        "ignored",
        "the detector's own; flat fields correct unequal pixels",
    ),
    *nexus_detector.KEYS,
    *nexus_axes.KEYS,
)
