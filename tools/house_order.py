"""From the ground up: the wings of the package, and the rooms of each.

A wing imports only from those before it, and within a wing a room (a folder, or a loose file) only
from those before it.  A new room goes as low as its imports let it.
"""

WINGS = [
    "units",
    "errors",
    "model",
    "files",
    "receiver",
    "simulation",
    "estimation",
    "calibration",
    "papers",
    "results",
    "jobs",
    "cli",
    "__main__",
    "__init__",
]

ROOMS = {
    wing: rooms.split()
    for wing, rooms in {
        "model": """
            arguments batches check_distance correlation counters drive field_map fixed_axes groups
            hall hermite imu_intrinsics marks perturbation physics platform_motion probe progress
            quaternion region response rotor short_repr steel_field temperature time_division trust
            aiding beacon magnetometer
            site trajectory
            truth_poses
            antenna channel_effects coil_field once one_axis receive_coils samples strapdown
            detection_range drive_signal field ground without_imu
            bandpass parameters path_field slips strapdown_steps
            noise prior slip_sampler waveform
        """,
        "files": """
            atomic bag_recovery bag_topics blas_threads commit messages parquet_bounds
            plain_data plain_table plausible pose_rows row_table site_draft site_ground
            lost_rows clock_steps site_values standard_streams stray_stamps
            aiding_messages bag_reader bag_rows checkpoint correlation field_map kept
            probe row_file survey table yaml_files
            attitude_table audio distances drive_columns fields hall instruments
            site_casing site_correlation site_motion site_region site_rotor
            site_temperature
            log_header row_stamps steel_file steel_map trajectory_table wells_file
            bag fix_table marks_table readings_table result_states
            site_plain site_text
            aiding_tables record_values site_response tum
            inertial_tables odometry_bag records site_magnetometer
            record_samples site_aiding stream trajectory_formats
            named_records named_samples site_beacon site_schema stream_contents
            log site
            foreign open site_changes
            table_stream
            long_log
        """,
        "receiver": """
            ambient bursts cells ellipse even_samples false_samples host_clock hum noise range_ends
            rotor rotor_phase sampling_clock turn windows
            admission ambient_left pieces slots
            design drive integration marked_bursts receiver reference slot_phasors slot_timing
            cycles lockin reference_clock
            even_clocks lockin_receiver running_clock slot_receiver
            joint marked
            receivers
        """,
        "simulation": """
            atmosphere demo_site ground layers magnetometers monte_carlo motion perturbed pipe shaft
            slots
            aiding inertial rotor rotor_beacons steel
            disturbance rails
            drift field steel_worlds wells
            events waveform
            config
            log
            endurance
        """,
        "estimation": """
            solve data_checks graph measurements posterior snapshot ranging demodulation batch
            integrity initialization online_integrity online orientation rests
        """,
        "calibration": """
            allan antenna beacon bench_response fieldmap graph magnetometer marked_snapshots
            static_field stops
            installation
            allan_fit antenna_graph antenna_observability antenna_probe antenna_site beacon_refined
            ellipsoid magnetometer_graph rest turn_coverage
            antenna_tracking magnetometer_start
            sphere_fit
            magnetometer_log
            magnetometer_size
        """,
        "papers": """
            p000_tracker p001_magnetometer p004_fingerprints register
            p002_beacon
        """,
        "results": """
            association dds_domain figures gauge odometry page_style pose_information provenance
            recording_file recording_steel ros_messages shapes trend
            alignment coverage drift errors live_foxglove observability odometry_dds
            odometry_mavlink recording_plots records_dds truth_frame
            axes refinement rest_figures shown transfer turn_guide verdict
            brief_plan coverage_colours design error_budget motion_coverage recording_layout
            recording_trust
            brief plots recording recording_drift
            page_motion recording_coverage recording_design recording_live screen
            page recording_turns trajectory
            report
            smoothed
        """,
        "jobs": """
            antenna_inputs fix_coil joint_kept listen_frames receiver_axes region_option
            rotor_inputs state_rows
            listen_lines listen_sound record_loop stream_clocks stream_samples written
            inputs navigate_results result_directory
            allan_noise checkpoint failure magnetometer_trust magnetometer_turns orientation
            budget_figures settings without_beacons
            coil typer_options
            coil_drive drift_conditions
            accept allan antenna_settings attitude_database calibrate_beacon calibrate_fieldmap
            calibrate_magnetometer calibrate_response check design_settings drift_world drive
            drift_events evaluate export import_figures init_settings
            listen live papers published_fix range_wells rates region replay rest_settings
            sheet simulate_ranging smooth_result survey view
            antenna_fit demodulate design_motion drift_figures fix import_log init_questions
            joint_tasks match_trust navigate_settings simulate smooth_correction smooth_failure
            stream
            antenna_report antenna_trust coverage drift init joint_calendar match record_source
            navigate_rests
            calibrate_antenna design_figures joint_driver navigate
            joint_run steel_of_logs
            joint_result
            calibrate_log design smooth
            demo
        """,
    }.items()
}
