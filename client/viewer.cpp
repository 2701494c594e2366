#include "client/viewer.h"

#include <fmt/chrono.h>
#include <fmt/format.h>

#include <utility>

#include "client/camera_control.h"
#include "common/check.h"
#include "common/image_io.h"

namespace tessera {
namespace {

constexpr std::uint64_t view_number = 1;
/// Pictures of more pixels than this are made smaller unless the user says otherwise.
constexpr std::size_t quick_pixels = 450000;
constexpr std::size_t plotted = 120;
/// Of half the picture's height: how near to a light's mark a click may be.
constexpr float mark_reach = 0.04f;
/// The window is drawn at least so often; network and user wake it sooner.
constexpr std::chrono::milliseconds draw_interval{30};
constexpr std::chrono::milliseconds status_interval{1000};
constexpr std::chrono::seconds notice_time{4};

/// Where the ray meets the plane through `p`.
std::optional<vec3> on_plane(const Ray& ray, const vec3& p, const vec3& normal) {
    const float t = dot(p - ray.org, normal) / dot(ray.dir, normal);
    return t > 0 && std::isfinite(t) ? std::optional(ray.org + t * ray.dir) : std::nullopt;
}

std::string dated_file(const char* extension) {
    return fmt::format("tessera-{:%Y%m%d-%H%M%S}.{}",
                       std::chrono::floor<std::chrono::seconds>(std::chrono::system_clock::now()),
                       extension);
}

}  // namespace

void Viewer::Series::add(double value) {
    values.push_back(float(value));
    if (values.size() > plotted) values.erase(values.begin());
}

Viewer::Viewer(const ViewerConfig& config, RenderClient& client, ViewerMemory& memory)
    : config_(config),
      client_(client),
      memory_(memory),
      window_(memory.window),
      camera_(config.camera),
      shown_(config.shown),
      flown_(Clock::now()),
      player_(config.motion, config.shape_error),
      replaying_since_(Clock::now()) {
    player_.play(true);
}

void Viewer::run() {
    auto drawn = Clock::now() - draw_interval;
    while (running_) {
        bool changed = window_.poll_events([this](const SDL_Event& event) { handle(event); });
        fly();
        play();
        replay();
        record();
        ask_for_pictures();
        client_.poll(std::chrono::milliseconds(changed ? 0 : 4));
        const int before = pictures_;
        take_what_arrived();
        if (!changed && pictures_ == before && Clock::now() - drawn < draw_interval) continue;
        drawn = Clock::now();
        window_.draw(picture_area(), [this] { draw_controls(); });
        end_if_asked_for();
    }
    memory_.window = window_.place();
    memory_.cameras[config_.scene] = camera_;
}

// ---- The picture --------------------------------------------------------------------------------

SDL_Rect Viewer::picture_area() const {
    const ImageSize size = window_.size();
    return {0, 0, std::max(size.width - (memory_.panel ? panel_width : 0), 16), size.height};
}

ImageSize Viewer::picture_size() const {
    const SDL_Rect area = picture_area();
    int divisor = std::max(divisor_, 1);
    const auto pixels = [&](int d) { return std::size_t(area.w / d) * std::size_t(area.h / d); };
    while (divisor_ == 0 && pixels(divisor) > quick_pixels) ++divisor;
    return {std::max(area.w / divisor, 1), std::max(area.h / divisor, 1)};
}

/// Tells the server what to show, when that has changed.
void Viewer::ask_for_pictures() {
    View view{.request = view_number,
              .spec = {},
              .format = config_.format,
              .tone_map = memory_.tone_map,
              .shown = shown_,
              .stamp = asked_.stamp};
    view.spec.scene = config_.scene;
    view.spec.size = picture_size();
    view.spec.camera = camera_;
    view.spec.settings = config_.settings;
    if (view == asked_) return;
    ++view.stamp;
    asked_at_[view.stamp] = Clock::now();
    client_.show(view);
    asked_ = view;
}

void Viewer::take_what_arrived() {
    if (auto picture = client_.take_picture()) show_picture(std::move(*picture));
    if (auto status = client_.take_status()) status_ = std::move(status);
    for (const std::string& complaint : client_.take_complaints()) {
        tell(complaint);
    }
    if (Clock::now() - status_asked_ < status_interval) return;
    status_asked_ = Clock::now();
    client_.ask_status();
}

void Viewer::show_picture(ShownPicture picture) {
    window_.set_picture(picture.srgb8, picture.size);
    const bool first = !picture_ || picture.about.stamp != picture_->about.stamp ||
                       picture.about.version != picture_->about.version;
    if (first) first_.add(1e3 * picture.about.first_seconds);
    if (picture.about.error_estimate > 0) error_.add(picture.about.error_estimate);
    if (const auto asked = asked_at_.find(picture.about.stamp); asked != asked_at_.end()) {
        latency_.add(1e3 * std::chrono::duration<double>(Clock::now() - asked->second).count());
        asked_at_.erase(asked_at_.begin(), std::next(asked));
    }
    picture_ = std::move(picture);
    ++pictures_;
}

void Viewer::save_picture() {
    if (!picture_) return;
    const std::string file = dated_file("png");
    write_srgb8(picture_->srgb8, picture_->size, file);
    tell("saved " + file);
}

void Viewer::tell(const std::string& notice) {
    notice_ = notice;
    notice_until_ = Clock::now() + notice_time;
}

// ---- Sessions -----------------------------------------------------------------------------------

void Viewer::toggle_recording() {
    if (!recorder_) {
        recorder_.emplace(scene());
        recording_since_ = Clock::now();
        return tell("recording: R again ends it");
    }
    const std::string file = dated_file("json");
    recorder_->save(file);
    tell(fmt::format("saved {}: {} steps", file, recorder_->steps().size()));
    recorder_.reset();
}

void Viewer::record() {
    if (!recorder_) return;
    const double seconds = std::chrono::duration<double>(Clock::now() - recording_since_).count();
    if (recorder_->steps().empty() || recorded_version_ != client_.scene().version)
        recorder_->see(seconds, scene());
    recorded_version_ = client_.scene().version;
    recorder_->see(seconds, camera_);
}

/// Does what is due of the recording that is being replayed.
void Viewer::replay() {
    const double seconds = std::chrono::duration<double>(Clock::now() - replaying_since_).count();
    for (; replayed_ < config_.replay.size(); ++replayed_) {
        const TimedEdit& step = config_.replay[replayed_];
        if (step.seconds > seconds) return;
        if (step.view) change_camera(*step.view);
        if (!step.operations.empty()) client_.send_edit(config_.scene, step.operations);
    }
}

void Viewer::end_if_asked_for() {
    if (config_.pictures == 0 || pictures_ < config_.pictures) return;
    running_ = false;
    if (!config_.screenshot.empty())
        write_srgb8(window_.pixels(), window_.size(), config_.screenshot);
}

// ---- The user -----------------------------------------------------------------------------------

void Viewer::handle(const SDL_Event& event) {
    const ImGuiIO& io = ImGui::GetIO();
    if (event.type == SDL_QUIT) running_ = false;
    if (event.type == SDL_KEYDOWN && !io.WantCaptureKeyboard) handle_key(event.key.keysym.sym);
    if (event.type == SDL_MOUSEBUTTONUP) handle_button(event.button);
    if (event.type == SDL_MOUSEMOTION) handle_motion(event.motion);
    if (io.WantCaptureMouse) return;
    if (event.type == SDL_MOUSEBUTTONDOWN) handle_button(event.button);
    if (event.type == SDL_MOUSEWHEEL)
        change_camera(approached(camera_, std::pow(1.12f, float(event.wheel.y))));
}

void Viewer::handle_key(SDL_Keycode key) {
    switch (key) {
        case SDLK_h:
        case SDLK_F1:
            help_ = !help_;
            break;
        case SDLK_TAB:
            memory_.panel = !memory_.panel;
            break;
        case SDLK_p:
        case SDLK_F12:
            save_picture();
            break;
        case SDLK_r:
            toggle_recording();
            break;
        case SDLK_SPACE:
            player_.play(!player_.playing());
            break;
        case SDLK_HOME:
            change_camera(config_.camera);
            break;
        case SDLK_DELETE:
            delete_selection();
            break;
        case SDLK_ESCAPE:
            help_ ? void(help_ = false) : select({}, {});
            break;
        default:
            break;
    }
}

vec2 Viewer::picture_point(int x, int y) const {
    const SDL_Rect area = picture_area();
    return vec2(2 * float(x) - float(area.w), float(area.h) - 2 * float(y)) / float(area.h);
}

/// In pixels of the window; nothing when it is behind the eye.
std::optional<vec2> Viewer::window_point(const vec3& p) const {
    const auto at = projected(camera_, p);
    if (!at) return std::nullopt;
    const SDL_Rect area = picture_area();
    return 0.5f * (vec2(area.w, area.h) + float(area.h) * vec2(at->x, -at->y));
}

void Viewer::handle_button(const SDL_MouseButtonEvent& button) {
    const bool shift = SDL_GetModState() & KMOD_SHIFT;
    if (button.state == SDL_RELEASED) {
        if (drag_ == Drag::orbit && !moved_) select_at(picture_point(button.x, button.y));
        drag_ = Drag::none;
        return;
    }
    moved_ = false;
    if (button.button == SDL_BUTTON_MIDDLE || (button.button == SDL_BUTTON_LEFT && shift))
        drag_ = Drag::pan;
    else if (button.button == SDL_BUTTON_RIGHT)
        drag_ = Drag::turn;
    else if (button.button == SDL_BUTTON_LEFT)
        drag_ = Drag::orbit;
    if (drag_ == Drag::orbit) take_hold(picture_point(button.x, button.y));
}

void Viewer::handle_motion(const SDL_MouseMotionEvent& motion) {
    if (drag_ == Drag::none) return;
    const float height = float(picture_area().h);
    const vec2 by(float(motion.xrel) / height, -float(motion.yrel) / height);
    moved_ = moved_ || by != vec2(0);
    if (drag_ == Drag::orbit) change_camera(orbited(camera_, by));
    if (drag_ == Drag::turn) change_camera(turned(camera_, by));
    if (drag_ == Drag::pan) change_camera(panned(camera_, by));
    if (drag_ == Drag::object || drag_ == Drag::arrow)
        drag_selection(picture_point(motion.x, motion.y));
}

/// Keys that are held down move the eye: a third of the way to the point looked at in a second.
void Viewer::fly() {
    const float seconds = std::min(
        std::chrono::duration<float>(Clock::now() - std::exchange(flown_, Clock::now())).count(),
        0.1f);
    if (ImGui::GetIO().WantCaptureKeyboard) return;
    const Uint8* down = SDL_GetKeyboardState(nullptr);
    const auto axis = [&](SDL_Scancode plus, SDL_Scancode minus) {
        return float(down[plus]) - float(down[minus]);
    };
    const vec3 by(axis(SDL_SCANCODE_D, SDL_SCANCODE_A), axis(SDL_SCANCODE_E, SDL_SCANCODE_Q),
                  axis(SDL_SCANCODE_W, SDL_SCANCODE_S));
    if (by == vec3(0)) return;
    const float speed =
        length(camera_.at - camera_.eye) / 3 * (SDL_GetModState() & KMOD_SHIFT ? 3 : 1);
    change_camera(flown(camera_, seconds * speed * by));
}

/// Puts what moves where it is by now.
void Viewer::play() {
    const auto edits = player_.step(scene(), client_.scene().version,
                                    picture_ ? picture_->about.version : 0, Clock::now());
    if (edits) client_.send_edit(config_.scene, edits->operations, edits->blobs);
}

void Viewer::change_camera(const Camera& camera) { camera_ = camera; }

// ---- The scene ----------------------------------------------------------------------------------

const Instance* Viewer::selected() const {
    for (const Instance& instance : scene().instances)
        if (!selected_.empty() && instance.name == selected_) return &instance;
    return nullptr;
}

const Light* Viewer::selected_light() const {
    for (const Light& light : scene().lights)
        if (!selected_light_.empty() && light.name == selected_light_) return &light;
    return nullptr;
}

/// The light whose mark is there.
const Light* Viewer::light_at(const vec2& point) const {
    for (const Light& light : scene().lights) {
        if (light.kind == LightKind::directional) continue;
        const auto at = projected(camera_, light.position);
        if (at && length(*at - point) < mark_reach) return &light;
    }
    return nullptr;
}

void Viewer::select_at(const vec2& point) {
    if (const Light* light = light_at(point)) return select({}, light->name);
    if (!picker_ || !picker_->knows(scene()))
        picker_.emplace(scene(), client_.fetch_blobs(config_.scene, scene().meshes));
    const auto picked = picker_->pick(scene(), eye_ray(camera_, point));
    select(picked ? scene().instances[picked->instance].name : "", {});
    if (picked) material_ = scene().materials[picked->material].name;
}

void Viewer::select(const std::string& instance, const std::string& light) {
    selected_ = instance;
    selected_light_ = light;
}

void Viewer::delete_selection() {
    if (selected()) edit(DeleteInstance{selected_});
    if (selected_light()) edit(DeleteLight{selected_light_});
    select({}, {});
}

/// In the middle of what is selected.
std::optional<Gizmo> Viewer::gizmo() const {
    const Light* light = selected_light();
    if (light && light->kind != LightKind::directional) return gizmo_at(camera_, light->position);
    const Instance* instance = selected();
    if (!instance || !picker_) return std::nullopt;
    const Box box = picker_->bounds(scene(), *instance);
    return box.empty() ? std::nullopt : std::optional(gizmo_at(camera_, 0.5f * (box.lo + box.hi)));
}

/// Of the light or instance that is selected.
vec3 Viewer::selected_place() const {
    const Light* light = selected_light();
    return light ? light->position : vec3(selected()->world_from_object[3]);
}

void Viewer::put_selection(const vec3& place) {
    if (selected_light())
        edit(SetLight{.light = selected_light_, .position = place});
    else
        edit(moved(*selected(), place));
}

/// What is selected is taken hold of: by an arrow, or where it is under the pointer.
void Viewer::take_hold(const vec2& point) {
    const auto arrows = gizmo();
    if (!arrows) return;
    const Ray ray = eye_ray(camera_, point);
    const auto arrow = arrow_at(camera_, *arrows, point);
    const auto along = arrow ? distance_along(*arrows, *arrow, ray) : std::nullopt;
    if (along) {
        arrow_ = *arrow;
        gripped_ = *arrows;
        grip_offset_ = selected_place() - *along * gripped_.axis(arrow_);
        drag_ = Drag::arrow;
        return;
    }
    if (const Light* light = selected_light()) {
        if (light_at(point) != light) return;
        grip_ = {.p = light->position};
    } else {
        const auto held = picker_->pick(scene(), ray);
        if (!held || scene().instances[held->instance].name != selected_) return;
        grip_ = *held;
    }
    grip_offset_ = selected_place() - grip_.p;
    drag_ = Drag::object;
}

/// Moves it along the arrow or in its ground plane, so that the point that was taken hold of stays
/// under the pointer.
void Viewer::drag_selection(const vec2& point) {
    if (!selected() && !selected_light()) return;
    const Ray ray = eye_ray(camera_, point);
    if (drag_ == Drag::object) {
        const auto to = on_plane(ray, grip_.p, normalize(camera_.up));
        if (to) put_selection(*to + grip_offset_);
    } else if (const auto along = distance_along(gripped_, arrow_, ray)) {
        put_selection(grip_offset_ + *along * gripped_.axis(arrow_));
    }
}

void Viewer::edit(EditOperation operation) {
    client_.send_edit(config_.scene, {std::move(operation)});
}

}  // namespace tessera
