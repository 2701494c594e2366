// A window with a picture and Dear ImGui over it: everything that talks to SDL. Drawn with SDL's
// own renderer, which any machine has, in software if need be.
#pragma once

#include <SDL.h>
#include <imgui.h>

#include <functional>
#include <memory>
#include <span>
#include <string>
#include <vector>

#include "common/image.h"

namespace tessera {

struct WindowConfig {
    std::string title;
    int x = SDL_WINDOWPOS_CENTERED, y = SDL_WINDOWPOS_CENTERED;
    ImageSize size{1280, 800};
};

class Window {
public:
    /// Throws UserError when there is no screen.
    explicit Window(const WindowConfig& config);
    ~Window();
    Window(const Window&) = delete;

    /// Hands over events since the last call, those for the controls included. Returns whether
    /// there were any.
    bool poll_events(const std::function<void(const SDL_Event&)>& handle);

    /// The picture shown from now on, three bytes per pixel.
    void set_picture(std::span<const std::uint8_t> rgb, ImageSize size);
    /// Draws the picture into `area` and over it what `controls` puts there.
    void draw(const SDL_Rect& area, const std::function<void()>& controls);

    WindowConfig place() const;
    ImageSize size() const;
    /// What was drawn last, three bytes per pixel.
    std::vector<std::uint8_t> pixels();

private:
    template <class T>
    using Owned = std::unique_ptr<T, void (*)(T*)>;

    void draw_controls();

    Owned<SDL_Window> window_;
    Owned<SDL_Renderer> renderer_;
    Owned<SDL_Texture> font_;
    Owned<SDL_Texture> picture_;
    ImageSize picture_size_;
};

}  // namespace tessera
