// The desktop viewer: shows a view that the server keeps rendering, moves its camera, picks and
// drags objects, edits materials and lights. Whatever it changes goes through the server, so all
// who watch the scene see it.
#pragma once

#include <chrono>
#include <deque>
#include <map>
#include <optional>
#include <string>
#include <vector>

#include "client/gizmo.h"
#include "client/motion_player.h"
#include "client/pick.h"
#include "client/recording.h"
#include "client/render_client.h"
#include "client/window.h"

namespace tessera {

/// Pixels of the window that the controls take.
inline constexpr int panel_width = 330;

/// What is remembered from one run to the next.
struct ViewerMemory {
    WindowConfig window;
    std::map<std::string, Camera> cameras;  ///< by scene
    ToneMap tone_map{.curve = ToneCurve::filmic, .exposure = 0.7f};
    bool panel = true;
};

struct ViewerConfig {
    std::string scene;  ///< an open scene of the server
    Camera camera;
    RenderSettings settings;  ///< passes: the picture has settled after so many
    PictureFormat format = PictureFormat::automatic;
    Channel shown = Channel::radiance;  ///< at first
    int pictures = 0;                   ///< end after so many; 0: when the user says so
    std::string screenshot;             ///< file for the whole window at the end; empty: none
    Motion motion;                      ///< of the scene, to be played
    std::vector<TimedEdit> replay{};    ///< looked at and changed as it says, once
    float shape_error = 0;              ///< of vertices that move, as edits_at() takes it
};

class Viewer {
public:
    Viewer(const ViewerConfig& config, RenderClient& client, ViewerMemory& memory);

    /// Until the user closes the window.
    void run();

private:
    using Clock = std::chrono::steady_clock;

    /// The last values of something, to be plotted.
    struct Series {
        std::vector<float> values;
        void add(double value);
        float newest() const { return values.empty() ? 0 : values.back(); }
    };

    // What happens, in viewer.cpp.
    void handle(const SDL_Event& event);
    void handle_key(SDL_Keycode key);
    void handle_button(const SDL_MouseButtonEvent& button);
    void handle_motion(const SDL_MouseMotionEvent& motion);
    void fly();
    void play();
    void select_at(const vec2& point);
    void select(const std::string& instance, const std::string& light);
    void take_hold(const vec2& point);
    void drag_selection(const vec2& point);
    void delete_selection();
    void ask_for_pictures();
    void take_what_arrived();
    void show_picture(ShownPicture picture);
    void save_picture();
    void tell(const std::string& notice);
    void record();
    void toggle_recording();
    void replay();
    void end_if_asked_for();
    vec2 picture_point(int x, int y) const;
    std::optional<vec2> window_point(const vec3& p) const;
    SDL_Rect picture_area() const;
    ImageSize picture_size() const;
    void change_camera(const Camera& camera);
    void edit(EditOperation operation);
    const Scene& scene() const { return client_.scene().scene; }
    const Instance* selected() const;
    const Light* selected_light() const;
    const Light* light_at(const vec2& point) const;
    std::optional<Gizmo> gizmo() const;
    vec3 selected_place() const;
    void put_selection(const vec3& place);

    // The controls, in viewer_panel.cpp.
    void draw_controls();
    void draw_panel();
    void draw_statistics();
    void draw_motion();
    void draw_display();
    void draw_cameras();
    void draw_selection();
    void draw_selected_box();
    void draw_light_marks();
    void draw_gizmo();
    void draw_material(const Material& material);
    void draw_light(const Light& light);
    void draw_lights();
    void draw_environment();
    void draw_workers();
    void draw_help();
    void draw_notice();
    void draw_legend();

    ViewerConfig config_;
    RenderClient& client_;
    ViewerMemory& memory_;
    Window window_;
    std::optional<Picker> picker_;  ///< once something has been picked
    Camera camera_;
    Channel shown_ = Channel::radiance;
    int divisor_ = 0;  ///< pixels of the window for one of the picture; 0: as few as are quick
    bool help_ = false;
    bool running_ = true;

    View asked_;  ///< last
    std::map<std::uint64_t, Clock::time_point> asked_at_;
    std::optional<ShownPicture> picture_;
    int pictures_ = 0;
    Series first_, latency_, error_;  ///< milliseconds, milliseconds, RMSE
    std::optional<Status> status_;
    Clock::time_point status_asked_;
    std::string notice_;
    Clock::time_point notice_until_;

    enum class Drag { none, orbit, turn, pan, object, arrow };
    Drag drag_ = Drag::none;
    bool moved_ = false;          ///< since the button went down
    std::string selected_;        ///< instance
    std::string selected_light_;  ///< or light
    std::string material_;        ///< under the pointer when it was selected
    Picked grip_;                 ///< where the selection is held
    vec3 grip_offset_{0};         ///< from there to its origin
    Gizmo gripped_;               ///< or the arrow by which it is held, where it was then
    int arrow_ = 0;
    Clock::time_point flown_;

    MotionPlayer player_;

    std::optional<Recorder> recorder_;  ///< while a session is recorded
    std::uint64_t recorded_version_ = 0;
    Clock::time_point recording_since_, replaying_since_;
    std::size_t replayed_ = 0;  ///< steps of config_.replay
};

}  // namespace tessera
